"""Shadows: what the sun does not reach, and the sky that vehicles hide from the ground beside."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from skyproof.geometry.projection import project
from skyproof.render.lighting import SceneLights
from skyproof.render.placed import Placed, Windows

_REACH_HEIGHTS = 1.0


@torch.no_grad()
def surrounded(placed: Placed) -> Float[Tensor, "N 2 2"]:
    """Returns two corners, in image pixels, of the ground that each contact shadow falls on."""
    reach_m = _REACH_HEIGHTS * placed.extent[:, 1, 2:]
    low, high = placed.vertices.amin(1)[:, :2] - reach_m, placed.vertices.amax(1)[:, :2] + reach_m
    corners = F.pad(torch.stack((low, high), dim=1), (0, 1))
    return project(corners, placed.sun, placed.gsd_m, placed.size_px)[0]


@torch.no_grad()
def shade_rows(placed: Placed, cast: Windows, lights: SceneLights) -> Float[Tensor, "N 16"]:
    """Returns each vehicle's shadow in its window as one row, as `kernels.shadow.Shade` has it."""
    sky, sunlit = lights.sky[placed.scene].mean(1, keepdim=True), placed.sunlit[:, None]
    heading, ground = placed.heading[:, None], placed.ground
    view = ground.new_tensor([[placed.gsd_m, placed.size_px / 2]]).expand(len(ground), -1)
    where = (cast.origin, ground[:, :2], heading.cos(), heading.sin())
    box = (placed.extent[:, 0, :2], placed.extent[:, 1])
    # In a photographed shadow there is less sun to lose, and less light in all.
    light = (sunlit, lights.overcast[placed.scene], (1 - sky) * sunlit + sky)
    return torch.cat((*where, *box, *light, view), dim=1)
