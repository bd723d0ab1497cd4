"""Vehicles as maps over the template's left half, as a network makes them, and back again."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.vehicles.template import COLUMNS
from skyproof.vehicles.texels import vertex_grid
from skyproof.vehicles.vehicle import TEXTURE_SIZE

MAP_PX = 64
"""Texels along a side of the learnt maps: 8 cm each, as fine as such photographs show."""


def whole(half: Float[Tensor, "*S W"]) -> Float[Tensor, "*S W2"]:
    """Mirrors the left half of a map."""
    return torch.cat((half, half.flip(-1)), dim=-1)


def unfolded(half: Float[Tensor, "N C S W"], side_px: int) -> Float[Tensor, "N C S2 S2"]:
    """Mirrors left halves of coarse maps, and spreads them smoothly over finer ones."""
    return F.interpolate(whole(half), size=(side_px, side_px), mode="bilinear")


def half_grid(vertices: Float[Tensor, "N V 3"]) -> Float[Tensor, "N 3 33 17"]:
    """Returns the left half of vehicles as a grid: nose pole, rings, tail pole by columns."""
    return vertex_grid(vertices)[:, :, : COLUMNS // 2 + 1].permute(0, 3, 1, 2)


def vertices_of(half: Float[Tensor, "3 33 17"]) -> Float[Tensor, "V 3"]:
    """Returns the vertices of a left half and its reflection.

    Points of the mid-plane are moved exactly onto it, and each pole becomes one point.
    """
    grid = half.permute(1, 2, 0).clone()
    grid[:, 0, 1] = 0.0
    grid[:, -1, 1] = 0.0
    right = grid[1:-1, 1:-1].flip(1) * grid.new_tensor([1.0, -1.0, 1.0])
    rings = torch.cat([grid[1:-1], right], dim=1).reshape(-1, 3)
    poles = grid[[0, -1]].mean(1)
    poles[:, 1] = 0.0
    return torch.cat([rings, poles]).float()


def part_map(shares: Float[Tensor, "7 64 32"]) -> UInt8[Tensor, "512 512"]:
    """Returns the part with the largest share of every texel, symmetrically."""
    fine = unfolded(shares[None], TEXTURE_SIZE)[0]
    return fine.argmax(0).to(torch.uint8)


def texture_map(
    albedo: Float[Tensor, "3 64 32"],
    shares: Float[Tensor, "7 64 32"],
    parts: UInt8[Tensor, "512 512"],
) -> UInt8[Tensor, "3 512 512"]:
    """Returns the fine texture of a coarse one.

    A texel takes the mean colour of its own part around it, so that edges are as sharp as the part
    map's.
    """
    texture = torch.zeros(3, TEXTURE_SIZE, TEXTURE_SIZE)
    colours = whole(albedo)
    for label in parts.unique().tolist():
        weight = whole(shares)[label].clamp(min=1e-4) ** 2
        # Beyond a part, its colour continues from its nearest texels.
        near = F.avg_pool2d(torch.cat((colours * weight, weight[None]))[None], 5, 1, 2)[0]
        own = torch.cat((colours * weight, weight[None])) + 0.05 * near
        fine = F.interpolate(
            (own[:3] / own[3:])[None], size=(TEXTURE_SIZE, TEXTURE_SIZE), mode="bilinear"
        )[0]
        texture = torch.where(parts == label, fine, texture)
    return (texture.clamp(0.0, 1.0) * 255).round().to(torch.uint8)
