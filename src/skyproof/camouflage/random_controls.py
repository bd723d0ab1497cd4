"""Vehicles that a detector is trained on, in random patterns and random shapes."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.randomness import generator_of
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.paints import varied_colours
from skyproof.vehicles.vehicle import VehicleBatch

# Colours of the ground over glass and wheels hide most, so they are drawn four times as often.
_KINDS = "U Ma Pix PixMa Lc LcMa PixLc PixLcMa Fc FcMa PixFc PixFcMa" + 3 * " Fc PixFc"
_TEXTURES = tuple(map(TextureConstraints.parse, _KINDS.split()))
# Coarser and finer than the attacks' 32 blocks, so that no detector learns one width by heart.
_BLOCKS = (8, 16, 32, 64)
_MOST_COLOURS = 8
# Beyond the 0.4 of the precheck, so that it is no extreme.
_MAGNITUDES = (0.1, 0.5)
# Standard deviations in CIELAB.
_WIDEST_LIGHTNESS = 30.0
_WIDEST_HUE = 20.0


class RandomPatterns:
    """Puts random controls of textures (section 5.4) on the vehicles that are marked for them.

    Every image shows new ones, because a detector may memorise a few hundred. The ids of the
    vehicles shown together seed the draws, so that the same images come back.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._marked = frozenset(_marked(fleet, "coat", "patterned"))

    @torch.no_grad()
    def __call__(self, vehicles: VehicleBatch) -> VehicleBatch:
        rows = [row for row, name in enumerate(vehicles.ids) if name in self._marked]
        generator = generator_of(0, "patterns", *vehicles.ids)
        texture = vehicles.texture.clone() if rows else vehicles.texture
        for row in rows:
            pattern = _pattern(generator).to(texture.device)
            (painted,) = pattern(vehicles.row(row)).worn_texture()
            texture[row] = (painted.clamp(0, 1) * 255).round().byte()
        return replace(vehicles, texture=texture)


def wear_random_shapes(fleet: Fleet, *, generator: torch.Generator) -> Fleet:
    """Puts random shapes (R-S-O) on the vehicles that are marked for them."""
    vertices = fleet.vertices.clone()
    low, high = _MAGNITUDES
    for name in _marked(fleet, "shape", "random"):
        magnitude = low + (high - low) * float(torch.rand((), generator=generator))
        shape = make_camouflage(
            CamouflageName("shape", magnitude=magnitude, random=True), generator=generator
        )
        with torch.no_grad():
            vertices[fleet.ids.index(name)] = shape(fleet.batch([name])).vertices[0]
    return replace(fleet, vertices=vertices)


def _marked(fleet: Fleet, key: str, value: str) -> list[str]:
    return [name for name in fleet.ids if fleet.sources.get(name, {}).get(key) == value]


def _pattern(generator: torch.Generator) -> Camouflage:
    texture, blocks, colours = torch.rand(3, generator=generator).tolist()
    name = CamouflageName("texture", _TEXTURES[int(texture * len(_TEXTURES))], random=True)
    settings = CamouflageSettings(
        colours=2 + int(colours * (_MOST_COLOURS - 1)), blocks=_BLOCKS[int(blocks * len(_BLOCKS))]
    )
    palette = _palette(settings.colours, generator)
    return make_camouflage(name, generator=generator, palette=palette, settings=settings)


def _palette(colours: int, generator: torch.Generator) -> Float[Tensor, "K 3"]:
    """Colours about a random, muted middle, spread wider in lightness than in hue, like ground."""
    middle = srgb_to_cielab(varied_colours(1, muted=1.0, generator=generator))
    light, hue = torch.rand(2, generator=generator).tolist()
    spread = torch.tensor([_WIDEST_LIGHTNESS * light, _WIDEST_HUE * hue, _WIDEST_HUE * hue])
    drawn = middle + spread * torch.randn(colours, 3, generator=generator)
    return cielab_to_srgb(drawn).clamp(0, 1)
