"""Vehicles that a detector is trained on, in random patterns and random shapes."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.paints import varied_colours

# Colours of the ground over glass and wheels hide most: four times as many vehicles wear them.
_TEXTURES = tuple(
    TextureConstraints.parse(name)
    for name in (
        *("U", "Ma", "Pix", "PixMa", "Lc", "LcMa", "PixLc", "PixLcMa"),
        *("Fc", "FcMa", "PixFc", "PixFcMa", *("Fc", "PixFc") * 3),
    )
)
# Coarser and finer than the attacks' 32 blocks, so that no detector learns one width by heart.
_BLOCKS = (8, 16, 32, 64)
_MOST_COLOURS = 8
# Beyond the 0.4 of the precheck, so that it is no extreme.
_MAGNITUDES = (0.1, 0.5)
# Standard deviations in CIELAB.
_WIDEST_LIGHTNESS = 30.0
_WIDEST_HUE = 20.0


def wear_random_controls(fleet: Fleet, *, generator: torch.Generator) -> Fleet:
    """Gives vehicles that are marked so random controls (section 5.4) of textures and of R-S-O."""
    patterned = _rows(fleet, "coat", "patterned")
    shaped = _rows(fleet, "shape", "random")
    if patterned:
        fleet = _paint(fleet, patterned, generator)
    return _shape(fleet, shaped, generator) if shaped else fleet


def _rows(fleet: Fleet, key: str, value: str) -> list[int]:
    marks = (fleet.sources.get(name, {}).get(key) for name in fleet.ids)
    return [row for row, mark in enumerate(marks) if mark == value]


def _paint(fleet: Fleet, rows: list[int], generator: torch.Generator) -> Fleet:
    textures = fleet.textures.clone()
    for turn, row in enumerate(rows):
        name = CamouflageName("texture", _TEXTURES[turn % len(_TEXTURES)], random=True)
        blocks, colours = torch.rand(2, generator=generator).tolist()
        settings = CamouflageSettings(
            colours=2 + int(colours * (_MOST_COLOURS - 1)),
            blocks=_BLOCKS[int(blocks * len(_BLOCKS))],
        )
        palette = _palette(settings.colours, generator)
        pattern = make_camouflage(name, generator=generator, palette=palette, settings=settings)
        with torch.no_grad():
            (painted,) = pattern(fleet.batch([fleet.ids[row]])).worn_texture()
        textures[row] = (painted.clamp(0, 1) * 255).round().byte()
    return replace(fleet, textures=textures)


def _shape(fleet: Fleet, rows: list[int], generator: torch.Generator) -> Fleet:
    vertices = fleet.vertices.clone()
    low, high = _MAGNITUDES
    for row in rows:
        magnitude = low + (high - low) * float(torch.rand((), generator=generator))
        name = CamouflageName("shape", magnitude=magnitude, random=True)
        shape = make_camouflage(name, generator=generator)
        with torch.no_grad():
            vertices[row] = shape(fleet.batch([fleet.ids[row]])).vertices[0]
    return replace(fleet, vertices=vertices)


def _palette(colours: int, generator: torch.Generator) -> Float[Tensor, "K 3"]:
    """Colours about a random, muted middle, spread wider in lightness than in hue, like ground."""
    middle = srgb_to_cielab(varied_colours(1, muted=1.0, generator=generator))
    light, hue = torch.rand(2, generator=generator).tolist()
    spread = torch.tensor([_WIDEST_LIGHTNESS * light, _WIDEST_HUE * hue, _WIDEST_HUE * hue])
    drawn = middle + spread * torch.randn(colours, 3, generator=generator)
    return cielab_to_srgb(drawn).clamp(0, 1)
