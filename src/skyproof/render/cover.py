"""Crowns and roofs of the photograph, which hide parts of the vehicles that stand beneath."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.geometry.rasterise import rasterise
from skyproof.render.placed import Placed, windows_around
from skyproof.scenes.scene import BackgroundWindow, Scene

# Pixels around a vehicle and its shadow that the sensor's blur reaches.
_BLUR_PX = 2


@torch.no_grad()
def covers(
    cover_of: Callable[[BackgroundWindow, int], Tensor | None],
    scenes: Sequence[Scene],
    placed: Placed,
    faces: Int[Tensor, "F 3"],
) -> Float[Tensor, "B 1 H W"] | None:
    """Returns the share of each pixel in which the photograph hides the vehicles; None for none.

    It is 0 around a vehicle on top of the cover (`Placement.covered` is 0 there) and its shadow.
    Cover is flat: it does not lean with the camera.
    """
    size_px = placed.size_px
    found: Float[Tensor, "B 1 H W"] | None = None
    for index, scene in enumerate(scenes):
        if not any(placement.covered for placement in scene.placements):
            continue
        cover = cover_of(scene.background, size_px)
        if cover is None:
            continue
        if found is None:
            found = placed.vertices.new_zeros(len(scenes), 1, size_px, size_px)
        found[index, 0] = cover.to(found)
    if found is None:
        return None
    # Vehicles on top, in the scenes in which others stand beneath.
    covered = torch.tensor(
        [placement.covered for scene in scenes for placement in scene.placements],
        device=found.device,
    )
    some = found.flatten(1).any(1)
    rows = torch.nonzero((covered == 0) & some[placed.scene])[:, 0]
    if len(rows):
        found = found.masked_fill(_drawn(placed, rows, faces, len(scenes)), 0.0)
    return found


def hidden(
    image: Float[Tensor, "B 3 H W"],
    photographs: Float[Tensor, "B 3 H W"],
    cover: Float[Tensor, "B 1 H W"],
) -> Float[Tensor, "B 3 H W"]:
    """Lays what covers the vehicles over them again; other pixels keep their bits."""
    return torch.where(cover > 0, torch.lerp(image, photographs, cover), image)


def _drawn(
    placed: Placed, rows: Int[Tensor, " K"], faces: Int[Tensor, "F 3"], count: int
) -> Bool[Tensor, "B 1 H W"]:
    """Returns the pixels of some vehicles and their shadows, and what the blur makes of them."""
    size_px = placed.size_px
    drawn = torch.zeros(count, 1, size_px, size_px, device=rows.device)
    for screen in (placed.screen[rows], placed.shadow_screen[rows]):
        window = windows_around(screen)
        samples = window.samples(screen, 1)
        seen = rasterise(samples, samples.new_zeros(samples.shape[:2]), faces, window.size)
        x = window.origin[seen.vehicle, 0] + seen.x
        y = window.origin[seen.vehicle, 1] + seen.y
        inside = (x >= 0) & (x < size_px) & (y >= 0) & (y < size_px)
        scene = placed.scene[rows][seen.vehicle]
        drawn[scene[inside], 0, y[inside], x[inside]] = 1.0
    return F.max_pool2d(drawn, 2 * _BLUR_PX + 1, stride=1, padding=_BLUR_PX) > 0
