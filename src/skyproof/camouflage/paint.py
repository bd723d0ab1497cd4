"""Paints without optimisation: one colour on body panels or on everything, or two tones."""

import itertools

import torch
from torch import Tensor

from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.camouflage.texture import UniversalTexture
from skyproof.vehicles.template import TOPOLOGY_BELT, column_u
from skyproof.vehicles.vehicle import TEXTURE_SIZE

Colour = tuple[int, int, int]
"""sRGB bytes: red, green, blue."""

_LEVELS = (0, 128, 255)

LATTICE: tuple[Colour, ...] = tuple(itertools.product(_LEVELS, _LEVELS, _LEVELS))
"""27 colours that span what paint can be: none, half and all of each of red, green and blue.

They lie on the border of sRGB too, so nothing is clipped and no colour lies outside of them.
"""

TWO_TONES: tuple[tuple[Colour, Colour], ...] = tuple(
    ((red, green, blue), (255 - red, 255 - green, 255 - blue))
    for red, green, blue in LATTICE
    if 128 not in (red, green, blue)
)
"""Eight pairs of a colour and its opposite: the largest contrasts that two tones can have."""


def plain_paint(colour: Colour, *, masked: bool) -> UniversalTexture:
    """Returns one colour as a finished texture, on painted panels (Ma) or everywhere."""
    srgb = torch.tensor(colour).view(3, 1, 1) / 255
    return finished_paint(f"plain_{bytes(colour).hex()}", srgb, masked=masked)


def two_tone_paint(upper: Colour, lower: Colour) -> UniversalTexture:
    """Returns a finished texture of two colours above and below the shoulder, on painted panels."""
    shoulder = float(column_u()[TOPOLOGY_BELT])
    u = (torch.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE
    above = (u > shoulder) & (u < 1 - shoulder)
    colours = torch.tensor([lower, upper]) / 255
    variant = f"two_tone_{bytes(upper).hex()}_{bytes(lower).hex()}"
    return finished_paint(variant, colours[above.long()].T[:, None, :], masked=True)


def finished_paint(
    variant: str, srgb: Tensor, *, masked: bool, repeat: str = ""
) -> UniversalTexture:
    """Returns a finished texture of these colours, on painted panels or everywhere."""
    constraints = TextureConstraints(masked=masked)
    name = CamouflageName("texture", constraints, random=True, variant=variant, repeat=repeat)
    paint = UniversalTexture(name, generator=torch.Generator())
    with torch.no_grad():
        paint.cells.copy_(srgb)
    paint.finalise()
    return paint.requires_grad_(False)
