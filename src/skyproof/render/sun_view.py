"""What the sun sees of vehicles: the rest of them, and of the ground, lies in their shadow."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.projection import project
from skyproof.geometry.rasterise import Visibility, at_corners, rasterise
from skyproof.render.placed import Placed, Windows

# Metres. The view has one depth for each of its samples, of a surface that it may see aslant. So
# what is tested stands a little off its surface, and is lit a little behind that depth, too.
_OFF_SURFACE_M = 0.05
_BEHIND_M = 0.05


@dataclass(frozen=True)
class SunView:
    """Vehicles as the sun sees them, projected along its rays onto the ground: a shadow map.

    Attributes:
        samples: shadows of the vertices in samples of the windows.
    """

    placed: Placed
    window: Windows
    factor: int
    samples: Float[Tensor, "N V 2"]
    visibility: Visibility

    @torch.no_grad()
    def places(
        self, normals: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"]
    ) -> Float[Tensor, "3 3 M"]:
        """Gives column, row and depth along the sun's rays of all faces' corners, a little off the
        surface.
        """
        placed = self.placed
        off = torch.add(placed.vertices, normals, alpha=_OFF_SURFACE_M)
        screen, depth = project(off, placed.sun, placed.gsd_m, placed.size_px)
        samples = self.window.samples(screen, self.factor)
        return at_corners(torch.cat((samples, depth[..., None]), dim=2), faces)

    @torch.no_grad()
    def reaches(
        self, place: Float[Tensor, "3 K"], vehicle: Int[Tensor, " K"]
    ) -> Float[Tensor, " K"]:
        """Says which points, given between corners of `places`, the sun sees: 1, or 0 behind a
        part.

        After Williams (1978), with the points taken off the surface along their normals.
        """
        wide = self.window.size * self.factor
        x, y = place[:2].floor().long().clamp(0, wide - 1)
        nearest = self.visibility.depth((vehicle * wide + y) * wide + x)
        return (nearest > place[2] - _BEHIND_M).to(place.dtype)


def see_from_sun(
    window: Windows, placed: Placed, faces: Int[Tensor, "F 3"], factor: int
) -> SunView:
    """Looks at vehicles as the sun does, with `factor` samples along a pixel's side."""
    samples = window.samples(placed.shadow_screen, factor)
    seen = rasterise(samples.detach(), placed.sun_depth.detach(), faces, window.size * factor)
    return SunView(placed, window, factor, samples, seen)
