"""A body pressed flat, whose lengths and areas on the UV map are known by hand."""

import torch

from skyproof.vehicles.template import column_u, make_template, row_v
from skyproof.vehicles.vehicle import Part, VehicleBatch

WIDTH_M = 5.12  # once around the body, there and back
LENGTH_M = 10.24


def flat_bodies(*scales: float) -> VehicleBatch:
    """One body per scale, all BODY: a texel between rings is 1 cm across, 2 cm along at scale 1."""
    u, v = column_u()[:-1], row_v()
    y = WIDTH_M * torch.minimum(u, 1 - u)
    x = LENGTH_M * (0.5 - v)
    rings = torch.stack(
        [x[1:-1, None].expand(31, 32), y.expand(31, 32), torch.zeros(31, 32)], dim=-1
    )
    poles = torch.tensor([[x[0], WIDTH_M / 4, 0.0], [x[-1], WIDTH_M / 4, 0.0]])
    vertices = torch.cat([rings.reshape(-1, 3), poles]).float()
    count = len(scales)
    return VehicleBatch(
        make_template(),
        torch.stack([scale * vertices for scale in scales]),
        torch.zeros(1, 3, 512, 512),
        torch.full((count, 512, 512), int(Part.BODY), dtype=torch.uint8),
        tuple(f"flat-{i}" for i in range(count)),
    )
