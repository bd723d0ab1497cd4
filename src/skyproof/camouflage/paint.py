"""Plain paints: one colour on the painted body panels or on the whole vehicle, not learnt."""

from __future__ import annotations

import itertools

import torch

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture

__all__ = ["LATTICE", "Colour", "plain_paint"]

Colour = tuple[int, int, int]
"""sRGB bytes: red, green, blue."""

_LEVELS = (0, 128, 255)

LATTICE: tuple[Colour, ...] = tuple(itertools.product(_LEVELS, _LEVELS, _LEVELS))
"""27 colours that span what paint can be: none, half and all of each of red, green and blue.

They lie on the border of sRGB too, so nothing is clipped and no colour lies outside of them.
"""


def plain_paint(colour: Colour, *, masked: bool) -> UniversalTexture:
    """Returns one colour as a finished camouflage: a universal texture of a single block.

    It is what the simplest of all attacks would put on a vehicle, and under the same mask the fair
    control of those that learn.

    Args:
        colour: sRGB bytes.
        masked: whether it lies on painted body panels only (Ma), or on everything.

    Returns:
        A texture named after its constraints and its colour, "R-PixMa_plain_ff8000".
    """
    name = CamouflageName(
        "texture",
        TextureConstraints(pixelised=True, masked=masked),
        random=True,
        variant=f"plain_{bytes(colour).hex()}",
    )
    paint = UniversalTexture(name, generator=torch.Generator(), blocks=1)
    with torch.no_grad():
        paint.cells.copy_(torch.tensor(colour).view(3, 1, 1) / 255)
    paint.finalise()
    return paint.requires_grad_(False)
