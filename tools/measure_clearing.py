"""Measures how close filled ground is to the true ground, and what detectors still find in it.

It makes the table of docs/imagery.md.

    python tools/measure_clearing.py --run-folder runs/trained

Vehicles are rendered onto the run's test tiles, so that the ground under them is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor
from torch.nn import functional

from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import detect_batch
from skyproof.detectors.loaded import LoadedDetector, load_detector
from skyproof.imagery.clearing.inpainting import Diffusion, Exemplar, Inpainting, apply_inpainting
from skyproof.imagery.clearing.vehicle_masks import darkness_profiles, estimate_shadow, vehicle_mask
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet

SIZE_PX, MARGIN_M = 272, 0.4
# Below this many grey levels a pixel counts as unchanged: sensor noise.
CHANGED = 12


@dataclass(frozen=True)
class MeasureClearing:
    """Masks, fills and compares.

    Attributes:
        run_folder: a finished demo: backgrounds, fleets/test and detectors are used.
        windows: how many.
    """

    run_folder: Path
    windows: int = 40

    @torch.no_grad()
    def run(self) -> None:
        """Prints one line per way to fill."""
        ground = BackgroundSet.open(self.run_folder / "backgrounds")
        fleet = Fleet.load(self.run_folder / "fleets" / "test")
        folders = sorted((self.run_folder / "detectors").iterdir())
        judges = [load_detector(folder) for folder in folders]
        settings = SceneSettings(size_px=SIZE_PX, vehicles_minimum=4, vehicles_maximum=6)
        draws = torch.Generator().manual_seed(11)
        scenes = sample_scenes(
            settings, ground, "test", fleet.sizes_m, self.windows, generator=draws
        )
        renderer, vehicles = TorchRenderer(ground), 0
        shown: list[Tensor] = []
        true: list[Tensor] = []
        masks: list[Tensor] = []
        covered: list[float] = []
        for scene in scenes:
            frames = renderer([scene], fleet.batch([each.vehicle for each in scene.placements]))
            image = (frames.image[0] * 255).round().byte()
            empty = (ground.window(scene.background, SIZE_PX) * 255).round().byte()
            shadow = estimate_shadow([darkness_profiles(image, frames.boxes, gsd_m=ground.gsd_m)])
            mask = vehicle_mask(
                (SIZE_PX, SIZE_PX), frames.boxes, shadow, gsd_m=ground.gsd_m, margin_m=MARGIN_M
            )
            changed = (image.float() - empty.float()).abs().amax(0) > CHANGED
            covered.append(float((changed & mask).sum() / changed.sum()))
            vehicles += len(frames.boxes)
            shown.append(image)
            true.append(empty)
            masks.append(mask)
        print(
            f"{vehicles} vehicles; masks cover {sum(covered) / len(covered):.1%} of the changed "
            "pixels"
        )
        print(
            f"found with vehicles {_found(judges, shown, masks)}, on the true ground "
            f"{_found(judges, true, masks)}"
        )
        ways: dict[str, Inpainting] = {
            "Telea": Diffusion("telea"),
            "Navier-Stokes": Diffusion("navier-stokes"),
            "exemplar": Exemplar(),
        }
        for name, way in ways.items():
            filled = [
                apply_inpainting(way, image, mask) for image, mask in zip(shown, masks, strict=True)
            ]
            errors = [
                (one.float() - other.float())[:, mask]
                for one, other, mask in zip(filled, true, masks, strict=True)
            ]
            texture = [
                float(_fine(one)[:, mask].std() / _fine(other)[:, mask].std())
                for one, other, mask in zip(filled, true, masks, strict=True)
            ]
            absolute = sum(float(each.abs().mean()) for each in errors) / len(errors)
            square = sum(float(each.square().mean()) for each in errors) / len(errors)
            print(
                f"{name:<14} mean absolute difference {absolute:.1f}, PSNR "
                f"{10 * math.log10(255**2 / square):.1f} dB, texture "
                f"{sum(texture) / len(texture):.2f}, found {_found(judges, filled, masks)}"
            )


def _found(
    judges: Sequence[LoadedDetector[Detector]], images: Sequence[Tensor], masks: Sequence[Tensor]
) -> list[int]:
    """Per detector its detections whose centre lies in a mask."""
    counts = []
    for judge in judges:
        count = 0
        for each, mask in zip(
            detect_batch(judge.detector, torch.stack(list(images))), masks, strict=True
        ):
            boxes = each.boxes[each.scores >= judge.threshold]
            x, y = ((boxes[:, :2] + boxes[:, 2:]) / 2).long().clamp(0, SIZE_PX - 1).unbind(1)
            count += int(mask[y, x].sum())
        counts.append(count)
    return counts


def _fine(image: Tensor) -> Tensor:
    padded = functional.pad(image.float()[None], (2, 2, 2, 2), mode="reflect")
    return image.float() - functional.avg_pool2d(padded, 5, 1)[0]


if __name__ == "__main__":
    tyro.cli(MeasureClearing).run()
