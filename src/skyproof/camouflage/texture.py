"""One universal texture map for all vehicles, without constraints: T-U when learnt, R-U as drawn (PAPER 27, 34)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from skyproof.camouflage.camouflage import Camouflage
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch

__all__ = ["UniversalTexture"]


class UniversalTexture(Camouflage):
    """Replaces every vehicle's texture by one map, windows, lights and wheels included (PAPER 27).

    As drawn it is its own random control R-U; optimised it is T-U (PAPER 34, 37).

    Attributes:
        texture: `[3, 512, 512]` sRGB in [0, 1], drawn uniformly.
    """

    def __init__(self, name: str, *, generator: torch.Generator) -> None:
        super().__init__()
        self.name = name
        self.texture = nn.Parameter(torch.rand(3, TEXTURE_SIZE, TEXTURE_SIZE, generator=generator))

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """The vehicles with this map as their common texture."""
        shared: Float[Tensor, "1 3 512 512"] = self.texture[None]
        return replace(vehicles, texture=shared)

    @torch.no_grad()
    def project_(self) -> None:
        """Clips colours to [0, 1]."""
        self.texture.clamp_(0.0, 1.0)

    @torch.no_grad()
    def finalise(self) -> None:
        """Rounds to the 8 bits per channel that the PNG holds."""
        self.texture.copy_((self.texture.clamp(0.0, 1.0) * 255).round() / 255)
