"""Measures how close the two renderers are, for docs/cycles.md.

It also draws their pictures of the same scenes side by side.

    python tools/compare_renderers.py --run-folder RUN --cycles RUN/datasets/test-cycles \\
        --out docs/results/cycles

RUN holds backgrounds/, fleets/test/, detectors/ and datasets/test/ (of the differentiable
renderer); --cycles is the dataset of the same scenes by `skyproof render --renderer cycles`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError
from skyproof.files import write_beside, write_json
from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.dataset import placed_vehicles
from skyproof.render.layers import draw_shadows
from skyproof.render.placed import label, place, visible_samples
from skyproof.render.renderer import photographs
from skyproof.render.settings import RenderSettings
from skyproof.render.sun_view import see_from_sun
from skyproof.render.windows import windows_around
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, read_scenes
from skyproof.vehicles.fleet import Fleet

SCENES = 12
COLUMNS = 2
ENLARGED = 2
# The blur mixes the border of vehicle and shadow with what lies beside them; only pixels this far
# inside are measured.
INSIDE_PX = 3
# Of a vehicle that stands in the sun hardly anything is in a shadow of the ground.
LIT = 0.02


@dataclass(frozen=True)
class Compare:
    """Compares a dataset of the differentiable renderer with one of Cycles.

    Attributes:
        run_folder: holds backgrounds, fleets/test, detectors and datasets/test.
        cycles: dataset of the same scenes by Cycles.
        out: folder for closeness.json and side_by_side.png.
    """

    run_folder: Path
    cycles: Path
    out: Path

    def run(self) -> None:
        """Measures, writes, prints."""
        first, second = self.run_folder / "datasets" / "test", self.cycles
        scenes = read_scenes(first / "scenes.jsonl")
        if read_scenes(second / "scenes.jsonl") != scenes:
            raise ConfigurationError(f"{second} does not show the scenes of {first}.")
        torch_images, cycles_images = Dataset.open(first), Dataset.open(second)
        pairs = [
            (torch_images.image(index), cycles_images.image(index))
            for index in range(len(torch_images))
        ]
        backgrounds, fleet = (
            BackgroundSet.open(self.run_folder / "backgrounds"),
            Fleet.load(self.run_folder / "fleets/test"),
        )
        figures: dict[str, Any] = {"images": len(scenes), "average_precision": {}}
        for folder in sorted((self.run_folder / "detectors").iterdir()):
            detector = load_detector(folder).detector
            figures["average_precision"][detector.name] = {
                name: average_precision(
                    match_images(detect_all(detector, images), images, criterion="centre_1m")
                )
                for name, images in (("torch", torch_images), ("cycles", cycles_images))
            }
        rows = [
            row
            for scene, pair in zip(scenes, pairs, strict=True)
            for row in vehicle_rows(scene, fleet, backgrounds, *pair)
        ]
        figures |= summary(rows)
        self.out.mkdir(parents=True, exist_ok=True)
        write_json(self.out / "closeness.json", figures)
        with write_beside(self.out / "side_by_side.png") as temporary:
            sheet(pairs[:SCENES]).save(temporary)
        print(figures)


@torch.no_grad()
def vehicle_rows(
    scene: Scene,
    fleet: Fleet,
    backgrounds: BackgroundSet,
    torch_image: Tensor,
    cycles_image: Tensor,
) -> list[dict[str, Any]]:
    """Measures by both renderers, per vehicle, the mean linear colour well inside it.

    The second figure is the light in its shadow over the photograph's; it counts apart for vehicles
    that stand in a shadow of the ground themselves.
    """
    if not scene.placements:
        return []
    settings = RenderSettings()
    vehicles = placed_vehicles(fleet, [scene])
    placed = place([scene], vehicles)
    photograph = photographs(backgrounds, [scene], torch.device("cpu"))
    cast = windows_around(placed.shadow_screen)
    seen, window = visible_samples(placed, vehicles.template.faces, settings.supersampling)
    bodies = label(photograph, placed, seen, window, settings.supersampling, masks=True).masks
    assert bodies is not None
    faces = vehicles.template.faces
    sun = see_from_sun(cast, placed, faces, settings.shadow_supersampling)
    shades = draw_shadows(sun, faces)[:, 0]
    shadows = (
        torch.stack(
            [
                on_image(shade, origin, placed.size_px)
                for shade, origin in zip(shades, cast.origin, strict=True)
            ]
        )
        > 0.99
    )
    ground = srgb_to_linear(photograph[0])
    light = {
        "torch": srgb_to_linear(torch_image / 255),
        "cycles": srgb_to_linear(cycles_image / 255),
    }
    rows = []
    for index in range(len(vehicles)):
        body = eroded(bodies[index] & ~(bodies.sum(0) > 1))
        shadow = eroded(shadows[index] & ~bodies.any(0) & ~(shadows.sum(0) > 1))
        row: dict[str, Any] = {"vehicle": vehicles.ids[index]}
        place_of_it = "shadow" if scene.placements[index].shade < LIT else "shadow_in_shade"
        for name, image in light.items():
            row[f"colour_{name}"] = image[:, body].mean(1).tolist() if body.sum() >= 20 else None
            row[f"{place_of_it}_{name}"] = (
                (image[:, shadow].sum(1) / ground[:, shadow].sum(1)).tolist()
                if shadow.sum() >= 10
                else None
            )
        rows.append(row)
    return rows


def on_image(layer: Tensor, origin: Tensor, size: int) -> Tensor:
    """A window's values in an image of their own."""
    whole = layer.new_zeros(size, size)
    left, top = origin.tolist()
    side = len(layer)
    rows, columns = (
        slice(max(top, 0), min(top + side, size)),
        slice(max(left, 0), min(left + side, size)),
    )
    if rows.start < rows.stop and columns.start < columns.stop:
        whole[rows, columns] = layer[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]
    return whole


def eroded(mask: Tensor) -> Tensor:
    """Without what is nearer to the mask's border than the blur reaches noticeably."""
    outside = (~mask).float()[None, None]
    return torch.nn.functional.max_pool2d(outside, 2 * INSIDE_PX + 1, 1, INSIDE_PX)[0, 0] == 0


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over vehicles, and how far single vehicles lie apart."""
    found: dict[str, Any] = {"vehicles": len(rows)}
    for what in ("colour", "shadow", "shadow_in_shade"):
        both = [
            (row[f"{what}_torch"], row[f"{what}_cycles"])
            for row in rows
            if row.get(f"{what}_torch")
        ]
        if not both:
            continue
        first, second = (np.array([pair[index] for pair in both]) for index in (0, 1))
        found[what] = {
            "measured": len(both),
            "torch": first.mean(0).round(4).tolist(),
            "cycles": second.mean(0).round(4).tolist(),
            "mean_absolute_difference": np.abs(second - first).mean(0).round(4).tolist(),
        }
    return found


def sheet(pairs: list[tuple[Tensor, Tensor]]) -> Image.Image:
    """Draws each scene by the differentiable renderer (left) and by Cycles (right).

    Some scenes stand in a row.
    """
    tiles = [torch.cat([*pair], dim=2) for pair in pairs]
    wide = torch.full((3, tiles[0].shape[1], 8), 255, dtype=torch.uint8)
    rows = []
    for start in range(0, len(tiles), COLUMNS):
        row = torch.cat(
            [torch.cat([tile, wide], dim=2) for tile in tiles[start : start + COLUMNS]], dim=2
        )[:, :, :-8]
        rows += [row, torch.full((3, 8, row.shape[2]), 255, dtype=torch.uint8)]
    picture = Image.fromarray(torch.cat(rows[:-1], dim=1).permute(1, 2, 0).numpy())
    return picture.resize(
        (picture.width * ENLARGED, picture.height * ENLARGED), Image.Resampling.BICUBIC
    )


if __name__ == "__main__":
    tyro.cli(Compare).run()
