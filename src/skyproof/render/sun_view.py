"""What the sun sees of vehicles: the rest of them, and of the ground, lies in their shadow."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.projection import project
from skyproof.geometry.rasterise import Visibility, rasterise
from skyproof.render.placed import Placed
from skyproof.render.windows import Windows

__all__ = ["SunView", "see_from_sun"]

# Metres. The view has one depth for each of its samples, of a surface that it may see aslant. So
# what is tested stands a little off its surface, and is lit a little behind that depth, too.
_OFF_SURFACE_M = 0.05
_BEHIND_M = 0.05


@dataclass(frozen=True)
class SunView:
    """Vehicles as the sun sees them, projected along its rays onto the ground: a shadow map.

    Attributes:
        placed: the vehicles.
        window: around the shadow of each.
        factor: samples along a pixel's side.
        samples: where the vertices' shadows fall, in samples of the windows.
        visibility: which face each of these samples sees.
    """

    placed: Placed
    window: Windows
    factor: int
    samples: Float[Tensor, "N V 2"]
    visibility: Visibility

    @torch.no_grad()
    def reaches(
        self, point: Float[Tensor, "3 K"], normal: Float[Tensor, "3 K"], vehicle: Int[Tensor, " K"]
    ) -> Float[Tensor, " K"]:
        """Says which points of vehicles' surfaces the sun sees: 1, or 0 behind another part.

        After Williams (1978), with the points taken off the surface along their normals.

        Args:
            point: metres, world frame.
            normal: unit normals there.
            vehicle: which vehicle each is on.
        """
        placed, wide = self.placed, self.window.size * self.factor
        off = torch.add(point, normal, alpha=_OFF_SURFACE_M).t()[:, None]
        sun = placed.sun.index_select(0, vehicle)
        screen, depth = project(off, sun, placed.gsd_m, placed.size_px)
        # The sample of the view that it falls on.
        origin = self.window.origin.index_select(0, vehicle)
        place = ((screen[:, 0] - origin) * self.factor).floor().long()
        x, y = place.clamp(0, wide - 1).t()
        nearest = self.visibility.depth((vehicle * wide + y) * wide + x)
        return (nearest > depth[:, 0] - _BEHIND_M).to(point.dtype)


def see_from_sun(
    window: Windows, placed: Placed, faces: Int[Tensor, "F 3"], factor: int
) -> SunView:
    """Looks at vehicles as the sun does.

    Args:
        window: around the shadow of each.
        placed: the vehicles.
        faces: of their template.
        factor: samples along a pixel's side.
    """
    samples = window.samples(placed.shadow_screen, factor)
    seen = rasterise(samples.detach(), placed.sun_depth.detach(), faces, window.size * factor)
    return SunView(placed, window, factor, samples, seen)
