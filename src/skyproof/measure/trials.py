"""Which changes the precheck tries: paints, sharpness, random controls, and the sun."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.paint import LATTICE, TWO_TONES, Colour, plain_paint, two_tone_paint
from skyproof.measure.views import Change
from skyproof.randomness import generator_of
from skyproof.results.precheck import Kind

BLURS_PX = (0.4, 0.7, 1.0, 1.4)
"""From the sharpest to the softest aerial photographs that we know, in pixels (sigma)."""

CONTROLS = ("R-U", "R-Pix", "R-Fc", "R-PixFc", "R-Lc", "R-S-O@0.4")

SUN_ELEVATIONS_DEG = (10.0, 25.0, 45.0, 65.0)


@dataclass(frozen=True)
class Trial:
    """One change to the same scenes that no attack optimised.

    Attributes:
        kind, name: as in `Rate`.
        change: what is changed.
    """

    kind: Kind
    name: str
    change: Change


def make_trials(palette: Float[Tensor, "K 3"], *, draws: int, seed: int) -> list[Trial]:
    """Makes all trials of a precheck.

    Args:
        palette: sRGB in [0, 1], the fixed colours of R-Fc and R-PixFc.
        draws: of every random control.
        seed: decides them.
    """
    kinds: tuple[tuple[Kind, bool], ...] = (("paint_body", True), ("paint_whole", False))
    paints = [
        _painted(kind, _hex(colour), plain_paint(colour, masked=masked))
        for kind, masked in kinds
        for colour in LATTICE
    ]
    paints += [
        _painted("two_tone", f"{_hex(upper)}{_hex(lower)}", two_tone_paint(upper, lower))
        for upper, lower in TWO_TONES
    ]
    blurs = [
        Trial("blur", f"{sigma:g} px", Change(f"{sigma:g} px", blur_sigma_px=sigma))
        for sigma in BLURS_PX
    ]
    controls = [
        _painted("control", name, _drawn(name, draw, palette, seed))
        for name in CONTROLS
        for draw in range(draws)
    ]
    suns = [
        Trial("sun", f"{angle:g}°", Change(f"{angle:g}°", sun_elevation_deg=angle))
        for angle in SUN_ELEVATIONS_DEG
    ]
    return [*paints, *blurs, *controls, *suns]


def _painted(kind: Kind, name: str, camouflage: Camouflage) -> Trial:
    return Trial(kind, name, Change(name, camouflage))


def _hex(colour: Colour) -> str:
    return f"#{bytes(colour).hex()}"


def _drawn(text: str, draw: int, palette: Float[Tensor, "K 3"], seed: int) -> Camouflage:
    name = CamouflageName.parse(text).with_repeat(draw)
    generator = generator_of(seed, "gate", str(name))
    return make_camouflage(name, generator=generator, palette=palette).requires_grad_(False)
