"""Measures how well cast shadows are found in pictures, on drawn ground, whose shadows are known.

It makes the table of docs/imagery.md.

    python tools/measure_cast_shadows.py --seed 1
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.cast_shadows import find_cast_shadows, light_left, shade_map


@dataclass(frozen=True)
class MeasureCastShadows:
    """Draws ground and looks for its shadows, each tile by itself.

    Attributes:
        tiles: how many are drawn.
        size_px: their side, at 12.5 cm.
        seed: of the drawing.
        least_sky, largest_sky: tiles whose sky gives more or less of the light are left out.
    """

    tiles: int = 160
    size_px: int = 384
    seed: int = 1
    least_sky: float = 0.0
    largest_sky: float = 1.0

    def run(self) -> None:
        """Prints shares by area, and how far the sky's part is off."""
        counts = {"where vehicles may stand": np.zeros(4), "all that nothing covers": np.zeros(4)}
        errors = []
        with tempfile.TemporaryDirectory() as folder:
            drawn = write_procedural_backgrounds(
                Path(folder), {"test": self.tiles}, self.size_px, seed=self.seed
            )
            for tile in drawn.tiles("test"):
                light = tile.light
                assert light is not None
                assert light.sun is not None
                sky = np.array(light.sky)
                if not self.least_sky <= sky.mean() <= self.largest_sky:
                    continue
                image = drawn.pixels(tile.id)
                shadows = find_cast_shadows(image, light, light.sun, gsd_m=drawn.gsd_m)
                left = light_left(shadows)
                none = torch.zeros(image.shape[1:], dtype=torch.uint8)
                found = none.numpy() > 0
                if left is not None:
                    size_px = (tile.height_px, tile.width_px)
                    found = shade_map(shadows, left, size_px, gsd_m=drawn.gsd_m) > 127
                    errors.append(np.array(left) - sky)
                true = _or(drawn.shade(tile.id), none) > 127
                uncovered = _or(drawn.cover(tile.id), none) == 0
                drivable = _or(drawn.directions(tile.id), none) > 0
                for ground, own in zip((drivable, uncovered), counts.values(), strict=True):
                    own += [
                        (true & found & ground).sum(),
                        (true & ~found & ground).sum(),
                        (~true & found & ground).sum(),
                        (~true & ~found & ground).sum(),
                    ]
        for name, (both, missed, wrong, neither) in counts.items():
            print(
                f"{name}: recall {both / (both + missed):.3f}, precision "
                f"{both / (both + wrong):.3f}, {wrong / (wrong + neither):.4f} of the sunlit taken"
            )
        off = np.abs(np.array(errors)).mean(1)
        print(
            f"sky on {len(off)} tiles: median error {np.median(off):.3f}, "
            f"{(off <= 0.06).mean():.0%} within 0.06, worst {off.max():.2f}"
        )


def _or(values: torch.Tensor | None, none: torch.Tensor) -> np.ndarray:
    return (none if values is None else values).numpy()


if __name__ == "__main__":
    tyro.cli(MeasureCastShadows).run()
