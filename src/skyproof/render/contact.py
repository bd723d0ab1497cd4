"""Contact shadows: the part of the sky that a vehicle hides from the ground around it."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.render.layers import Windows
from skyproof.render.placed import Placed

__all__ = ["contact_shadows", "surrounded"]

# A long wall of height h hides (1 - d / sqrt(d^2 + h^2)) / 2 of the sky's light from level ground
# at a distance d. The edge of a box under a Gaussian of this many heights falls off alike, within
# 0.06 up to one and a half heights, and has corners, too.
_SPREAD = 0.6
_REACH_HEIGHTS = 1.2


def surrounded(placed: Placed) -> Float[Tensor, "N 2 2"]:
    """Returns two corners, in image pixels, of the ground that each contact shadow falls on."""
    reach_m = _REACH_HEIGHTS * placed.extent[:, 1, 2:]
    low = placed.vertices[..., :2].detach().amin(1) - reach_m.detach()
    high = placed.vertices[..., :2].detach().amax(1) + reach_m.detach()
    corners = torch.stack((low, high), dim=1)
    flip = corners.new_tensor([1.0, -1.0]) / placed.gsd_m
    return corners * flip + placed.size_px / 2


def contact_shadows(window: Windows, placed: Placed) -> Float[Tensor, "N 1 S S"]:
    """Computes the part of the sky's light that vehicles take from the ground beside them.

    Every vehicle counts as a box as long, wide and high as it is. It is differentiable in these.
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
    return hidden[:, None]


def _between(
    place: Float[Tensor, "N S S"], ends: Float[Tensor, "N 2"], spread: Float[Tensor, " N"]
) -> Float[Tensor, "N S S"]:
    scale = spread.reciprocal()[:, None, None]
    low = ends[:, 0, None, None]
    high = ends[:, 1, None, None]
    return 0.5 * (torch.erf((place - low) * scale) - torch.erf((place - high) * scale))
