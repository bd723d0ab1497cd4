"""Crowns and roofs of the photograph, which hide parts of the vehicles that stand beneath."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.render.placed import Placed
from skyproof.scenes.scene import BackgroundWindow, Scene

__all__ = ["covers", "hidden"]

Cut = Callable[[BackgroundWindow, int], Tensor | None]
"""Gives the part of each pixel of a window that crowns and roofs cover, `[H, W]`, or None."""

# Around a vehicle that stands on a roof, in its own lengths, nothing is hidden: the cover is below
# it.
_FREE_LENGTHS = 1.0


@torch.no_grad()
def covers(cut: Cut, scenes: Sequence[Scene], placed: Placed) -> Float[Tensor, "B 1 H W"] | None:
    """Returns the part of each pixel in which the photograph hides the vehicles.

    It is 0 around vehicles that stand on top of what covers the ground, as uniform places have it
    (`Placement.covered` is 0 there). Cover is taken to be flat: it does not lean with the camera.

    Args:
        cut: of the background set.
        scenes: as drawn.
        placed: their vehicles.

    Returns:
        None where no vehicle of these scenes stands beneath anything.
    """
    like = placed.vertices
    size_px = placed.size_px
    found = like.new_zeros(len(scenes), 1, size_px, size_px)
    any_found = False
    first = 0
    for index, scene in enumerate(scenes):
        rows = range(first, first + len(scene.placements))
        first = rows.stop
        if not any(placement.covered for placement in scene.placements):
            continue
        cover = cut(scene.background, size_px)
        if cover is None:
            continue
        any_found = True
        found[index, 0] = cover.to(like)
        for row, placement in zip(rows, scene.placements, strict=True):
            if not placement.covered:
                found[index, 0] *= _outside(placed, row)
    return found if any_found else None


def hidden(
    image: Float[Tensor, "B 3 H W"],
    photographs: Float[Tensor, "B 3 H W"],
    cover: Float[Tensor, "B 1 H W"],
) -> Float[Tensor, "B 3 H W"]:
    """Lays what covers the vehicles over them again; other pixels keep their bits."""
    return torch.where(cover > 0, torch.lerp(image, photographs, cover), image)


def _outside(placed: Placed, row: int) -> Float[Tensor, "H W"]:
    """Returns 0 around a vehicle and 1 elsewhere."""
    length_m = placed.extent[row, 1, 0] - placed.extent[row, 0, 0]
    radius_px = _FREE_LENGTHS * length_m / placed.gsd_m
    middle = placed.size_px / 2
    steps = torch.arange(placed.size_px, device=placed.vertices.device) + 0.5 - middle
    east = steps[None] - placed.ground[row, 0] / placed.gsd_m
    south = steps[:, None] + placed.ground[row, 1] / placed.gsd_m
    return (torch.hypot(east, south) > radius_px).to(placed.vertices)
