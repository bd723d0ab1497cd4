"""Coats that few real vehicles wear: any plain colour, two tones, a livery.

A detector trained on catalogue paints alone takes colour for evidence. These coats prevent that.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.vehicles.canvas import TextureCanvas, between
from skyproof.vehicles.paints import DARKEST, LIGHTEST
from skyproof.vehicles.vehicle import Part

Coat = Literal["catalogue", "plain", "two_tone", "livery", "patterned"]
"""How a vehicle is painted: "catalogue" as real ones are; "patterned" in a random pattern that
`skyproof.camouflage.random_controls` lays over a catalogue paint."""

_HUES = torch.tensor([[-87.0, 99.0], [-108.0, 95.0]])  # sRGB's a* and b* lie within
_CANDIDATES = 64
# CIELAB lightness of a pair of a dark and a light tone.
_DARK_BELOW, _LIGHT_ABOVE = 25.0, 80.0


def varied_colours(
    count: int, *, muted: float = 0.5, generator: torch.Generator
) -> Float[Tensor, "count 3"]:
    """Draws sRGB colours in [0.03, 0.97] of all kinds, a part of them `muted`, as primer and dust
    are.

    Hardly a hundredth of CIELAB is nearly grey, and detectors trained on it alone lost vehicles in
    one grey or beige (docs/results/detectors). Muted colours keep a part u ** 2 of their chroma, u
    uniform, and are uniform in lightness.
    """
    cielab = srgb_to_cielab(_uniform_colours(count, generator=generator))
    chance, kept, lightness = torch.rand(3, count, 1, generator=generator)
    cielab[:, 1:] *= torch.where(chance < muted, kept**2, 1.0)
    cielab[:, :1] = torch.where(chance < muted, 100 * lightness, cielab[:, :1])
    return cielab_to_srgb(cielab).clamp(DARKEST, LIGHTEST)


def _uniform_colours(count: int, *, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Draws colours uniformly from the part of CIELAB that sRGB can show."""
    found = torch.zeros(0, 3)
    while len(found) < count:
        draws = torch.rand(_CANDIDATES, 3, generator=generator)
        low, high = _HUES.T
        cielab = torch.cat([100 * draws[:, :1], low + (high - low) * draws[:, 1:]], dim=1)
        srgb = cielab_to_srgb(cielab)
        # What sRGB cannot show was clipped, and does not come back.
        shown = (srgb_to_cielab(srgb) - cielab).abs().amax(1) < 0.5
        found = torch.cat([found, srgb[shown]])
    return found[:count].clamp(DARKEST, LIGHTEST)


def lay_coat(
    canvas: TextureCanvas, coat: Coat, *, generator: torch.Generator
) -> Float[Tensor, " 3"]:
    """Paints a canvas plain, in two tones or in a livery; returns the sRGB of the bumpers."""
    if coat == "two_tone":
        return _two_tones(canvas, generator)
    (colour,) = varied_colours(1, generator=generator)
    canvas.fill(_everywhere(canvas), colour, Part.BODY)
    if coat == "livery":
        _livery(canvas, generator)
    return colour


def _everywhere(canvas: TextureCanvas) -> Tensor:
    return torch.ones_like(canvas.z, dtype=torch.bool)


def _two_tones(canvas: TextureCanvas, generator: torch.Generator) -> Tensor:
    """Paints the roof, all that is seen from above, or the lower half in a second colour."""
    first, second = _pair(generator)
    kind = int(torch.randint(4, (1,), generator=generator))
    canvas.fill(_everywhere(canvas), first, Part.BODY)
    if kind == 0:
        where = canvas.upper & (canvas.z > canvas.rail_z - 0.05)
    elif kind == 1:
        where = canvas.z < 0.5 * canvas.body.dimensions.height
    else:
        where = canvas.upper.expand_as(canvas.z)
    canvas.fill(where, second, Part.BODY)
    return first


def _pair(generator: torch.Generator) -> Float[Tensor, "2 3"]:
    """Draws two colours; two pairs in three are a dark and a light one, mostly the second dark."""
    colours = varied_colours(2, generator=generator)
    contrast, swap, *parts = torch.rand(4, generator=generator).tolist()
    if contrast < 1 / 3:
        return colours
    cielab = srgb_to_cielab(colours)
    lightness = [_DARK_BELOW * parts[0], 100 - (100 - _LIGHT_ABOVE) * parts[1]]
    cielab[:, 0] = torch.tensor(lightness[::-1] if swap < 0.75 else lightness)
    return cielab_to_srgb(cielab).clamp(DARKEST, LIGHTEST)


def _livery(canvas: TextureCanvas, generator: torch.Generator) -> None:
    """One to four signs of a fleet: stripes along, bands across, chequers, panels."""
    dimensions = canvas.body.dimensions
    count = 1 + int(torch.randint(4, (1,), generator=generator))
    colours = varied_colours(count, generator=generator)
    for colour in colours:
        kind = int(torch.randint(5, (1,), generator=generator))
        place, width, other = torch.rand(3, generator=generator).tolist()
        along = place * dimensions.length
        if kind == 0:
            # A stripe along the sides.
            middle = dimensions.clearance + place * (dimensions.height - dimensions.clearance)
            where = between(canvas.z - middle, -0.04 - 0.2 * width, 0.04 + 0.2 * width)
        elif kind == 1:
            # Stripes along bonnet, roof and boot.
            middle = place * 0.7 * dimensions.width / 2
            where = canvas.upper & between(
                canvas.y - middle, -0.05 - 0.2 * width, 0.05 + 0.2 * width
            )
        elif kind == 2:
            # A band across, leaning as it goes up.
            lean = (other - 0.5) * 2 * canvas.z
            half = 0.1 + 0.7 * width
            where = between(canvas.behind - along + lean, -half, half)
        elif kind == 3:
            # Chequers, as rescue vehicles have them.
            side = 0.25 + 0.45 * width
            squares = torch.floor(canvas.behind / side) + torch.floor((canvas.z + canvas.y) / side)
            where = (squares % 2) == 0
        else:
            # Everything before or behind a place.
            where = canvas.behind < along
        canvas.fill(where.expand_as(canvas.z), colour, Part.BODY)
