"""Paints of vehicles as frequent as on streets, and paints that few real vehicles have.

A detector trained on catalogue paints alone takes colour for evidence. The rare paints prevent
that: any plain colour, two tones, a livery.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.vehicles.canvas import TextureCanvas, between
from skyproof.vehicles.vehicle import Part

Coat = Literal["catalogue", "plain", "two_tone", "livery", "patterned"]
"""How a vehicle is painted: "catalogue" as real ones are; "patterned" with a catalogue paint, over
which `skyproof.camouflage.random_controls` lays another pattern in every image."""

_DARKEST, _LIGHTEST = 0.03, 0.97  # sRGB; no paint is blacker or whiter
# White cars in use are no whiter; if they were, a high sun would overexpose whole roofs.
_WHITEST_CAR = 0.91
_HUES = torch.tensor([[-87.0, 99.0], [-108.0, 95.0]])  # ranges of a* and b* in sRGB
_CANDIDATES = 64
# A quarter of muted colours are nearly black, up to this CIELAB lightness: black vehicles look like
# shadows and dark bays, and a detector trained on few of them lost 20 to 29 % to black paint.
_BLACK_SHARE, _BLACK_BELOW = 0.25, 12.0
# CIELAB lightness of a pair of a dark and a light tone.
_DARK_BELOW, _LIGHT_ABOVE = 25.0, 80.0

# Shares of cars on roads, our estimates from aerial photographs of two European towns (KIT AIS and
# Minsk): about a fifth white, a third black, blue-black or dark grey. Cars built in one year are
# another matter: white 34 %, black 21, grey 19, silver 8, blue 8, red 5, green 1 (Axalta Global
# Automotive Color Popularity Report 2022).
PAINT_SHARES: dict[str, float] = {
    "white": 0.22,
    "black": 0.28,
    "grey": 0.13,
    "silver": 0.16,
    "blue": 0.10,
    "red": 0.07,
    "green": 0.01,
    "brown": 0.02,
    "yellow": 0.01,
}
_WHITE_VANS = 0.7  # our estimate, the rest follows the table

# Typical diffuse sRGB of each colour space: our estimates, not measured.
PAINT_TONES: dict[str, list[tuple[float, float, float]]] = {
    "white": [(0.91, 0.91, 0.90), (0.89, 0.90, 0.90), (0.90, 0.89, 0.86)],
    "black": [(0.07, 0.07, 0.08), (0.09, 0.10, 0.12), (0.07, 0.09, 0.15), (0.09, 0.11, 0.19)],
    "grey": [(0.30, 0.31, 0.33), (0.40, 0.41, 0.42), (0.23, 0.24, 0.26)],
    "silver": [(0.66, 0.67, 0.69), (0.74, 0.75, 0.76), (0.60, 0.62, 0.64)],
    "blue": [(0.10, 0.20, 0.40), (0.08, 0.13, 0.27), (0.22, 0.34, 0.50), (0.12, 0.18, 0.34)],
    "red": [(0.58, 0.06, 0.07), (0.43, 0.06, 0.09), (0.68, 0.11, 0.08)],
    "green": [(0.11, 0.26, 0.17), (0.30, 0.36, 0.26)],
    "brown": [(0.33, 0.24, 0.18), (0.64, 0.57, 0.47), (0.45, 0.38, 0.31)],
    "yellow": [(0.86, 0.66, 0.11), (0.80, 0.34, 0.08)],
}


def sample_paint(body_type: str, *, generator: torch.Generator) -> tuple[str, Float[Tensor, " 3"]]:
    """Draws a colour name and its sRGB in [0, 1]."""
    draws = torch.rand(3, generator=generator)
    shares = torch.tensor(list(PAINT_SHARES.values()))
    drawn = int((draws[0] * shares.sum() > shares.cumsum(0)).sum())
    name = list(PAINT_SHARES)[min(drawn, len(shares) - 1)]
    if body_type == "van" and float(draws[1]) < _WHITE_VANS:
        name = "white"
    tones = PAINT_TONES[name]
    tone = torch.tensor(tones[min(int(draws[2] * len(tones)), len(tones) - 1)])
    lightness = 1 + 0.08 * torch.randn(1, generator=generator)
    tint = 0.006 * torch.randn(3, generator=generator)
    return name, (tone * lightness + tint).clamp(_DARKEST, _WHITEST_CAR)


def varied_colours(
    count: int, *, muted: float = 0.5, generator: torch.Generator
) -> Float[Tensor, "count 3"]:
    """Draws sRGB colours of all kinds; the share `muted` is as dull as primer and dust.

    Hardly a hundredth of CIELAB is nearly grey, and detectors trained on uniform draws alone missed
    vehicles in one grey or beige (docs/results/detectors). Muted colours keep u ** 2 of their
    chroma, with u uniform, and have uniform lightness, except for a quarter that is nearly black.
    """
    cielab = srgb_to_cielab(_uniform_colours(count, generator=generator))
    chance, kept, lightness = torch.rand(3, count, 1, generator=generator)
    most = torch.where(chance < _BLACK_SHARE * muted, _BLACK_BELOW, 100.0)
    cielab[:, 1:] *= torch.where(chance < muted, kept**2, 1.0)
    cielab[:, :1] = torch.where(chance < muted, most * lightness, cielab[:, :1])
    return cielab_to_srgb(cielab).clamp(_DARKEST, _LIGHTEST)


def _uniform_colours(count: int, *, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Draws colours uniformly from the part of CIELAB that sRGB can show."""
    found = torch.zeros(0, 3)
    while len(found) < count:
        draws = torch.rand(_CANDIDATES, 3, generator=generator)
        low, high = _HUES.T
        cielab = torch.cat([100 * draws[:, :1], low + (high - low) * draws[:, 1:]], dim=1)
        srgb = cielab_to_srgb(cielab)
        # Colours that sRGB cannot show were clipped, and convert back to other values.
        shown = (srgb_to_cielab(srgb) - cielab).abs().amax(1) < 0.5
        found = torch.cat([found, srgb[shown]])
    return found[:count].clamp(_DARKEST, _LIGHTEST)


def lay_coat(
    canvas: TextureCanvas, coat: Coat, *, generator: torch.Generator
) -> Float[Tensor, " 3"]:
    """Paints a canvas plain, in two tones or in a livery; returns the sRGB of the bumpers."""
    if coat == "two_tone":
        return _two_tones(canvas, generator)
    (colour,) = varied_colours(1, generator=generator)
    canvas.fill(torch.ones_like(canvas.z, dtype=torch.bool), colour, Part.BODY)
    if coat == "livery":
        _livery(canvas, generator)
    return colour


def _two_tones(canvas: TextureCanvas, generator: torch.Generator) -> Tensor:
    """Paints the roof, all that is seen from above, or the lower half in a second colour."""
    first, second = _pair(generator)
    kind = int(torch.randint(4, (1,), generator=generator))
    where = canvas.upper.expand_as(canvas.z)
    if kind == 0:
        where = where & (canvas.z > canvas.rail_z - 0.05)
    elif kind == 1:
        where = canvas.z < 0.5 * canvas.body.dimensions.height
    canvas.fill(torch.ones_like(where), first, Part.BODY)
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
    return cielab_to_srgb(cielab).clamp(_DARKEST, _LIGHTEST)


def _livery(canvas: TextureCanvas, generator: torch.Generator) -> None:
    """Paints one to four fleet markings: stripes along, bands across, chequers, panels."""
    dimensions = canvas.body.dimensions
    count = 1 + int(torch.randint(4, (1,), generator=generator))
    for colour in varied_colours(count, generator=generator):
        kind = int(torch.randint(5, (1,), generator=generator))
        place, width, other = torch.rand(3, generator=generator).tolist()
        along = place * dimensions.length
        if kind == 0:
            # A stripe along the sides.
            middle = dimensions.clearance + place * (dimensions.height - dimensions.clearance)
            half = 0.04 + 0.2 * width
            where = between(canvas.z - middle, -half, half)
        elif kind == 1:
            # Stripes along bonnet, roof and boot.
            middle = place * 0.7 * dimensions.width / 2
            half = 0.05 + 0.2 * width
            where = canvas.upper & between(canvas.y - middle, -half, half)
        elif kind == 2:
            # A slanting band across.
            lean = (other - 0.5) * 2 * canvas.z
            half = 0.1 + 0.7 * width
            where = between(canvas.behind - along + lean, -half, half)
        elif kind == 3:
            # Chequers, as on rescue vehicles.
            side = 0.25 + 0.45 * width
            squares = torch.floor(canvas.behind / side) + torch.floor((canvas.z + canvas.y) / side)
            where = (squares % 2) == 0
        else:
            # Everything ahead of one station.
            where = canvas.behind < along
        canvas.fill(where.expand_as(canvas.z), colour, Part.BODY)
