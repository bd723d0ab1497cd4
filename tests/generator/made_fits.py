"""Fits that tests make up, where no picture is needed."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from skyproof.generator.fits import Fit, Prototype
from skyproof.generator.maps import MAP_PX


def made_fits(prototypes: Sequence[Prototype], count: int) -> list[Fit]:
    """Draws fits of white, red and black vehicles."""
    generator = torch.Generator().manual_seed(8)
    paints = torch.tensor([[0.9, 0.9, 0.9], [0.6, 0.08, 0.08], [0.08, 0.08, 0.09]])
    fits = []
    for number in range(count):
        noise = torch.randn(3, MAP_PX, MAP_PX // 2, generator=generator)
        fits.append(
            Fit(
                id=f"made-{number:03d}",
                prototype=number % len(prototypes),
                reversed=False,
                shift_m=(0.0, 0.0),
                turn_rad=0.0,
                stretch=(1.0 + 0.01 * (number % 3), 1.0),
                paint=(paints[number % 3] + 0.02 * torch.rand(3, generator=generator)),
                glass=torch.tensor([0.1, 0.12, 0.14]),
                detail=0.01 * noise,
                seen=torch.ones(MAP_PX, MAP_PX // 2),
                misfit=0.01,
                runner_up=0.1,
            )
        )
    return fits
