"""What a name says: "T-PixFcMa", "S-O@0.4", "C-Fc-par@0.2", and their random controls (PAPER 34, 52, 53)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.names import base_name
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError

__all__ = ["Materials", "Recipe", "make_camouflage", "read_recipe"]

_TEXTURE = re.compile(r"(?P<kind>[TR])-(?P<constraints>[A-Za-z]+)")
_SHAPE = re.compile(r"(?P<random>R-)?S-O@(?P<magnitude>[-+.\w]+)")
_LEARNT = re.compile(r"C-(?P<constraints>[A-Za-z]+)-(?P<order>seq|par)@(?P<magnitude>[-+.\w]+)")
_DRAWN = re.compile(r"R-C-(?P<constraints>[A-Za-z]+)@(?P<magnitude>[-+.\w]+)")


@dataclass(frozen=True)
class Recipe:
    """A name, read.

    Attributes:
        name: the whole name, with its variant and repeat.
        texture: constraints of the texture; None where vehicles keep their own.
        magnitude: PM of the shape; None where the shape stays.
        order: of a combined attack.
        random: drawn, not learnt.
    """

    name: str
    texture: TextureConstraints | None
    magnitude: float | None
    order: Literal["seq", "par"] | None
    random: bool


@dataclass(frozen=True)
class Materials:
    """What some camouflages are made from.

    Attributes:
        palette: `[K, 3]` sRGB, for fixed colours (Fc).
        texture: a finished one, for a sequential combination.
        colours: how many are learnt (Lc).
        blocks: pixel blocks a side (Pix).
        turn_steps: of a parallel combination.
        literal: the paper's own form of the colour restriction.
    """

    palette: Float[Tensor, "K 3"] | None = None
    texture: Camouflage | None = None
    colours: int = 5
    blocks: int = 32
    turn_steps: int = 10
    literal: bool = False


def read_recipe(name: str) -> Recipe:
    """Reads a name; a repeat ("-2") and a variant ("_on_retinanet") at its end change nothing.

    Raises:
        ConfigurationError: no such camouflage, contradictory constraints, or PM outside [0, 1].
    """
    base = base_name(name)
    if match := _TEXTURE.fullmatch(base):
        constraints = TextureConstraints.parse(match["constraints"])
        return Recipe(name, constraints, None, None, random=match["kind"] == "R")
    if match := _SHAPE.fullmatch(base):
        return Recipe(
            name, None, _magnitude(match["magnitude"], name), None, random=bool(match["random"])
        )
    if match := _LEARNT.fullmatch(base):
        order: Literal["seq", "par"] = "seq" if match["order"] == "seq" else "par"
        constraints = TextureConstraints.parse(match["constraints"])
        return Recipe(name, constraints, _magnitude(match["magnitude"], name), order, random=False)
    if match := _DRAWN.fullmatch(base):
        constraints = TextureConstraints.parse(match["constraints"])
        return Recipe(name, constraints, _magnitude(match["magnitude"], name), None, random=True)
    raise ConfigurationError(
        f"{name!r} names no camouflage; expected for instance T-U, T-PixFcMa, S-O@0.4, C-Fc-seq@0.2 or C-Fc-par@0.2, "
        "or a random control such as R-PixFc, R-S-O@0.4 or R-C-Fc@0.2."
    )


def make_camouflage(
    recipe: Recipe, materials: Materials, *, generator: torch.Generator
) -> Camouflage:
    """The camouflage at the start of its attack, or the finished random control.

    Raises:
        ConfigurationError: a material is missing or does not fit.
    """
    if recipe.order == "seq":
        given = materials.texture
        assert recipe.texture is not None
        if not isinstance(given, UniversalTexture) or given.constraints != recipe.texture:
            raise ConfigurationError(
                f"{recipe.name} expects the finished texture T-{recipe.texture.name} to put the shape on, got "
                f"{'none' if given is None else given.name}; give its folder with --texture."
            )
        assert recipe.magnitude is not None
        made: Camouflage = Combination(
            recipe.name, given, DisplacementMap(recipe.name, recipe.magnitude)
        )
    elif recipe.texture is None:
        made = _shape(recipe, generator)
    else:
        texture = UniversalTexture(
            recipe.name,
            recipe.texture,
            generator=generator,
            palette=_palette(recipe, materials),
            colours=materials.colours,
            blocks=materials.blocks,
            literal=materials.literal,
        )
        turns = None if recipe.random else materials.turn_steps
        made = (
            texture
            if recipe.magnitude is None
            else Combination(recipe.name, texture, _shape(recipe, generator), turn_steps=turns)
        )
    if recipe.random:
        made.finalise()
    return made


def _shape(recipe: Recipe, generator: torch.Generator) -> DisplacementMap:
    assert recipe.magnitude is not None
    return DisplacementMap(
        recipe.name, recipe.magnitude, generator=generator if recipe.random else None
    )


def _palette(recipe: Recipe, materials: Materials) -> Tensor | None:
    assert recipe.texture is not None
    if recipe.texture.colours != "fixed":
        return None
    if materials.palette is None:
        raise ConfigurationError(f"{recipe.name} expects fixed colours; give them with --palette.")
    return materials.palette


def _magnitude(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 <= value <= 1:
        raise ConfigurationError(
            f"{name} expects a perturbation magnitude (PM) from 0 to 1 after the @, got {text}."
        )
    return value
