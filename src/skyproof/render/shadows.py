"""Shadows: what the sun does not reach, and the sky that vehicles hide from the ground beside."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import at_corners
from skyproof.geometry.projection import project
from skyproof.geometry.rasterise import Visibility, rasterise
from skyproof.render.lighting import Lighting
from skyproof.render.placed import Placed, Windows

# Metres. The view has one depth for each of its samples, of a surface that it may see aslant. So
# what is tested stands a little off its surface, and is lit a little behind that depth, too.
_OFF_SURFACE_M = 0.05
_BEHIND_M = 0.05
# A box under a Gaussian of this many heights, times this share because its sides give light back,
# is within 0.02 of what path tracing takes from ground beside vehicles under an overcast sky.
_SPREAD = 0.45
_SHARE = 0.85
_REACH_HEIGHTS = 1.0
# A Gaussian never ends; ground that loses no more than this keeps its light.
_FAINTEST = 2e-3
# Of a clear sky's light, what is missing in a cast shadow far from the vehicle, and towards it.
_FAR_LOSS = 0.2
_NEAR_LOSS = 0.9


@dataclass(frozen=True)
class SunView:
    """Vehicles as the sun sees them, projected along its rays onto the ground: a shadow map."""

    placed: Placed
    window: Windows
    factor: int
    samples: Float[Tensor, "N V 2"]
    visibility: Visibility

    @torch.no_grad()
    def places(
        self, normals: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"]
    ) -> Float[Tensor, "3 3 M"]:
        """Gives column, row and depth along the sun's rays of all faces' corners, a little off."""
        placed = self.placed
        off = torch.add(placed.vertices, normals, alpha=_OFF_SURFACE_M)
        screen, depth = project(off, placed.sun, placed.gsd_m, placed.size_px)
        samples = self.window.samples(screen, self.factor)
        return at_corners(torch.cat((samples, depth[..., None]), dim=2), faces)

    @torch.no_grad()
    def reaches(
        self, place: Float[Tensor, "3 K"], vehicle: Int[Tensor, " K"]
    ) -> Float[Tensor, " K"]:
        """Says which points between corners of `places` the sun sees: 1, or 0 behind a part.

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


def surrounded(placed: Placed) -> Float[Tensor, "N 2 2"]:
    """Returns two corners, in image pixels, of the ground that each contact shadow falls on."""
    reach_m = _REACH_HEIGHTS * placed.extent[:, 1, 2:]
    low = placed.vertices[..., :2].detach().amin(1) - reach_m.detach()
    high = placed.vertices[..., :2].detach().amax(1) + reach_m.detach()
    corners = torch.stack((low, high), dim=1)
    flip = corners.new_tensor([1.0, -1.0]) / placed.gsd_m
    return corners * flip + placed.size_px / 2


def contact_shadows(window: Windows, placed: Placed) -> Float[Tensor, "N 1 S S"]:
    """The share of the sky's light that vehicles take from the ground beside them.

    Every vehicle counts as a box. It is differentiable in the box's size.
    """
    # Where the window's pixels lie, in metres along each vehicle's axes.
    steps = torch.arange(window.size, device=window.origin.device) + 0.5
    centre = placed.size_px / 2
    east = (window.origin[:, 0, None] + steps - centre) * placed.gsd_m - placed.ground[:, :1]
    north = -(window.origin[:, 1, None] + steps - centre) * placed.gsd_m - placed.ground[:, 1:2]
    cosine = placed.heading.cos()[:, None, None]
    sine = placed.heading.sin()[:, None, None]
    along = cosine * east[:, None, :] + sine * north[:, :, None]
    across = cosine * north[:, :, None] - sine * east[:, None, :]
    # A box under a Gaussian is a product of two smooth steps.
    spread_m = _SPREAD * placed.extent[:, 1, 2] * math.sqrt(2)
    hidden = _between(along, placed.extent[..., 0], spread_m)
    hidden = hidden * _between(across, placed.extent[..., 1], spread_m)
    return (_SHARE * hidden[:, None] - _FAINTEST).clamp(min=0.0)


def ground_shadows(
    cast: Float[Tensor, "N 1 S S"], contact: Float[Tensor, "N 1 S S"], light: Lighting
) -> Float[Tensor, "N 2 S S"]:
    """Returns the shares of sun and sky that vehicles take from the ground.

    In the cast shadow a fifth of a clear sky is missing, because the vehicle hides the brighter
    half around the sun, and more towards the vehicle. Beside it in the sun nothing is missing,
    because the bright side gives back what it hides. Both agree with path tracing (docs/cycles.md).
    Without direct sun there is the contact shadow.
    """
    sunlit = light.sunlit[:, :, None, None]
    clear = sunlit * (1 - light.overcast[:, :, None, None])
    sky_lost = clear * cast * (_FAR_LOSS + _NEAR_LOSS * contact) + (1 - clear) * contact
    # In a photographed shadow there is less sun to lose, of less light in all.
    share = light.sky.mean(1)[:, None, None, None]
    left = (1 - share) * sunlit + share
    return (torch.cat((cast * sunlit, sky_lost), dim=1) / left).clamp(max=1.0)


def _between(
    place: Float[Tensor, "N S S"], ends: Float[Tensor, "N 2"], spread: Float[Tensor, " N"]
) -> Float[Tensor, "N S S"]:
    scale = spread.reciprocal()[:, None, None]
    low = ends[:, 0, None, None]
    high = ends[:, 1, None, None]
    return 0.5 * (torch.erf((place - low) * scale) - torch.erf((place - high) * scale))
