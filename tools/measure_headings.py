"""Measures how well headings are estimated from pictures and the upright boxes around vehicles.

It makes the table of docs/imagery.md.

    python tools/measure_headings.py runs/trained/datasets/test runs/trained/datasets/validation

Rendered datasets know the ground that every vehicle stands on, and so its heading.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor
from tyro.conf import Positional

from skyproof.imagery.clearing.heading import estimate_stance

Box = tuple[float, float, float, float]

LOOSE_M, NOISE_M, NOISY_M, POINT_M = 0.2, 0.15, 0.3, 0.3
"""Boxes drawn by hand: too large by this much, and each side off by so much (standard deviations);
and how far a point label lies from the vehicle's middle."""


@dataclass(frozen=True)
class MeasureHeadings:
    """Estimates headings of known vehicles.

    Attributes:
        datasets: rendered dataset folders.
        count: how many vehicles, drawn at random.
        seed: of this draw, and of the errors of boxes that are drawn by hand.
    """

    datasets: Positional[tuple[Path, ...]]
    count: int = 300
    seed: int = 0

    def run(self) -> None:
        """Prints one row of the table per kind of box."""
        rng = np.random.default_rng(self.seed)
        vehicles = [one for folder in self.datasets for one in _vehicles(folder)]
        chosen = [vehicles[index] for index in rng.permutation(len(vehicles))[: self.count]]

        def by_hand(box: Box, gsd_m: float, grown_m: float, noise_m: float) -> Box:
            off = rng.normal(0, noise_m, 4) + grown_m * np.array([-1, -1, 1, 1])
            left, top, right, bottom = np.array(box) + off / gsd_m
            return left, top, right, bottom

        def around_a_point(box: Box, gsd_m: float) -> Box:
            x = (box[0] + box[2]) / 2 + rng.normal(0, POINT_M / gsd_m)
            y = (box[1] + box[3]) / 2 + rng.normal(0, POINT_M / gsd_m)
            half = 2.0 / gsd_m
            return x - half, y - half, x + half, y + half

        kinds: dict[str, Callable[[Box, float], Box]] = {
            "as rendered": lambda box, gsd_m: box,
            f"{LOOSE_M} m larger on each side, ± {NOISE_M} m": lambda box, gsd_m: by_hand(
                box, gsd_m, LOOSE_M, NOISE_M
            ),
            f"each side ± {NOISY_M} m": lambda box, gsd_m: by_hand(box, gsd_m, 0.0, NOISY_M),
            f"4 m around a point that is off by {POINT_M} m": around_a_point,
        }
        for name, drawn in kinds.items():
            errors, unknown = [], 0
            for image, box, heading_rad, gsd_m in chosen:
                stance = estimate_stance(image, drawn(box, gsd_m), gsd_m)
                if stance is None:
                    unknown += 1
                    continue
                errors.append(abs((math.degrees(stance[0] - heading_rad) + 90) % 180 - 90))
            wide = np.mean(np.array(errors) > 20)
            print(f"| {name} | {np.median(errors):.1f}° | {wide:.1%} | {unknown} unknown")


def _vehicles(folder: Path) -> Iterator[tuple[Tensor, Box, float, float]]:
    """Gives of every wholly visible vehicle its picture, box, heading and metres per pixel."""
    document = json.loads((folder / "annotations.json").read_text())
    files = {row["id"]: folder / row["file_name"] for row in document["images"]}
    pictures: dict[int, Tensor] = {}
    for row in document["annotations"]:
        if row["iscrowd"] or "corners_px" not in row or row["visible_fraction"] < 0.999:
            continue
        number = row["image_id"]
        if number not in pictures:
            with Image.open(files[number]) as picture:
                pictures[number] = torch.from_numpy(np.array(picture)).permute(2, 0, 1)
        left, top, width, height = row["bbox"]
        corners = np.array(row["corners_px"])
        ahead = corners[:2].mean(0) - corners[2:].mean(0)
        heading_rad = math.atan2(-ahead[1], ahead[0]) % math.pi
        box = (left, top, left + width, top + height)
        yield pictures[number], box, heading_rad, document["info"]["gsd_m"]


if __name__ == "__main__":
    tyro.cli(MeasureHeadings).run()
