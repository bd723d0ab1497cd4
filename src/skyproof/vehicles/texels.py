"""How large a texel of the UV map is on a vehicle, in centimetres."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.vehicles.template import (
    COLUMNS,
    RINGS,
    TOPOLOGY_BELT,
    TOPOLOGY_RAIL,
    TOPOLOGY_SILL,
    column_u,
    row_v,
)
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, VehicleBatch

__all__ = ["texel_sizes"]


def texel_sizes(vehicles: VehicleBatch) -> dict[str, float]:
    """Median size of a texel over the vehicles of a batch.

    The regions are roof, bonnet, sides (between sill and shoulder), glass and underside. Bonnet and roof are the
    painted texels inside the roof rail before and behind the first glass of the middle column.

    Args:
        vehicles: procedural vehicles on the template of `make_template`.

    Returns:
        centimetres, keys such as "roof_u_cm" (across, around the body) and "roof_v_cm" (along, nose to tail).
    """
    rings = vehicles.vertices[:, : RINGS * COLUMNS].view(-1, RINGS, COLUMNS, 3).double().cpu()
    closed = torch.cat([rings, rings[:, :, :1]], dim=2)
    u, v = column_u(), row_v()
    size_u = closed.diff(dim=2).norm(dim=-1) / (u.diff() * TEXTURE_SIZE) * 100
    size_v = closed.diff(dim=1).norm(dim=-1) / (v[1:-1].diff() * TEXTURE_SIZE)[:, None] * 100
    centre = (torch.arange(TEXTURE_SIZE, dtype=torch.float64) + 0.5) / TEXTURE_SIZE
    column = (torch.searchsorted(u, centre) - 1).clamp(0, COLUMNS - 1)
    row = (torch.searchsorted(v, centre) - 2).clamp(0, RINGS - 2)
    texel_u = size_u[:, row][:, :, column]
    texel_v = size_v[:, row][:, :, column]

    sizes = {}
    for name, mask in _regions(vehicles, column).items():
        sizes[f"{name}_u_cm"] = float(texel_u[mask].median())
        sizes[f"{name}_v_cm"] = float(texel_v[mask].median())
    return sizes


def _regions(vehicles: VehicleBatch, column: Tensor) -> dict[str, Tensor]:
    parts = vehicles.parts.cpu()
    body, glass = parts == Part.BODY, parts == Part.GLASS
    half_column = torch.minimum(column, COLUMNS - 1 - column)
    first_glass = glass[:, :, TEXTURE_SIZE // 2].int().argmax(1)
    behind = torch.arange(TEXTURE_SIZE)[None] >= first_glass[:, None]
    rail_height = _centre_height(vehicles)
    high = rail_height > 0.9 * rail_height.amax(1, keepdim=True)
    top = body & (half_column >= TOPOLOGY_RAIL)
    return {
        "roof": top & (behind & high)[:, :, None],
        "bonnet": top & ~behind[:, :, None],
        "sides": body & (half_column >= TOPOLOGY_SILL) & (half_column < TOPOLOGY_BELT),
        "glass": glass,
        "underside": parts == Part.UNDERSIDE,
    }


def _centre_height(vehicles: VehicleBatch) -> Float[Tensor, "N 512"]:
    """Height of the middle of the roof line at each row of the map."""
    half = COLUMNS // 2
    heights = vehicles.vertices[:, half : RINGS * COLUMNS : COLUMNS, 2].cpu()
    ends = torch.stack([heights[:, 0], heights[:, -1]], dim=1)
    line = torch.cat([ends[:, :1], heights, ends[:, 1:]], dim=1)
    return torch.nn.functional.interpolate(line[:, None], size=TEXTURE_SIZE, mode="linear", align_corners=True)[:, 0]
