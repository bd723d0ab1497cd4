"""Camouflages from their names: "T-PixFcMa", "S-O@0.4", "C-Fc-par@0.2", "R-PixFcMa"."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.displacement import DisplacementMap, even_shape
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.paint import LATTICE, plain_paint
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError
from skyproof.randomness import generator_of


def make_camouflage(
    name: str | CamouflageName,
    *,
    generator: torch.Generator,
    palette: Float[Tensor, "K 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> Camouflage:
    """Makes any camouflage from its name: at the start of its attack, or finished if it is random.

    Args:
        name: such as "T-PixFcMa", "S-O@0.4", "C-Fc-seq@0.2" or "R-PixFc"; a variant and a repeat
            at its end change nothing.
        generator: on the CPU; textures, and the shapes of random controls, are drawn from it.
        palette: `[K, 3]` sRGB in [0, 1]; fixed colours (Fc) expect one, and colours that are learnt
            for a palette or for blocks begin there, where it is given.
        texture: a finished texture, or a combination that has one; a sequential combination expects
            it to put its shape on, and so does a random shape on an attack's own texture.
        settings: what the name leaves open; the defaults where not given.

    Raises:
        ConfigurationError: the name is none, or palette or texture are missing or do not fit.
    """
    name = CamouflageName.parse(name) if isinstance(name, str) else name
    settings = settings or CamouflageSettings()
    if name.kind == "other":
        raise ConfigurationError(
            f"{name} names no camouflage that can be made; see skyproof attack --help."
        )
    made: Camouflage
    if name.order == "seq" or (name.order == "par" and name.random):
        made = Combination(name, _finished(texture, name), _shape(name, generator))
    elif name.kind == "shape":
        made = _shape(name, generator)
    else:
        made = _texture(name, generator, palette, settings)
        if name.kind == "combination":
            turns = None if name.random else settings.turn_steps
            made = Combination(name, made, _shape(name, generator), turn_steps=turns)
    if name.random:
        made.finalise()
    return made


def draw_control(
    name: CamouflageName,
    *,
    seed: int,
    palette: Float[Tensor, "K 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> Camouflage:
    """Draws a random control, such as "R-PixFc-3"; name and seed decide it.

    Args:
        name: of a random control, with its repeat.
        seed: of the run.
        palette, texture, settings: as of `make_camouflage`.
    """
    generator = generator_of(seed, "control", str(name))
    return make_camouflage(
        name, generator=generator, palette=palette, texture=texture, settings=settings
    )


def make_candidates(
    name: CamouflageName,
    draws: int,
    *,
    seed: int,
    palette: Float[Tensor, "K 3"] | None = None,
    settings: CamouflageSettings | None = None,
) -> list[Camouflage]:
    """Makes what a control is chosen from.

    Args:
        name: of the control: "R-Ma_plain", 27 plain paints under its mask; "R-S-O@0.4_plain", every
            vertex out as far as it may, under the vehicle's own paint; "R-C-Ma@0.2_plain", both;
            "R-PixFc_best", the first so many draws of R-PixFc.
        draws: how many draws.
        seed: decides them, as of the draws by themselves.
        palette, settings: as of `make_camouflage`.

    Raises:
        ConfigurationError: no such control.
    """
    if name.choice == "plain":
        return _plain(name)
    if name.choice != "best":
        raise ConfigurationError(f"{name} names no control that is chosen from others.")
    names = [name.base.with_repeat(draw) for draw in range(draws)]
    return [draw_control(each, seed=seed, palette=palette, settings=settings) for each in names]


def _plain(name: CamouflageName) -> list[Camouflage]:
    """Every plain paint under the name's mask, every vertex out, or both."""
    if name.constraints is None:
        return [even_shape(name)]
    paints = [plain_paint(colour, masked=name.constraints.masked) for colour in LATTICE]
    if name.kind == "texture":
        return list(paints)
    return [Combination(paint.name, paint, even_shape(name)) for paint in paints]


def _finished(texture: Camouflage | None, name: CamouflageName) -> UniversalTexture:
    constraints = name.constraints
    if isinstance(texture, Combination):
        texture = texture.texture
    if isinstance(texture, UniversalTexture) and texture.constraints == constraints:
        return texture
    wanted = CamouflageName("texture", constraints)
    got = "none" if texture is None else texture.name
    raise ConfigurationError(
        f"{name} expects the finished texture {wanted} to put the shape on, got {got}; "
        "give its folder with --texture."
    )


def _shape(name: CamouflageName, generator: torch.Generator) -> DisplacementMap:
    return DisplacementMap(name, generator=generator if name.random else None)


def _texture(
    name: CamouflageName,
    generator: torch.Generator,
    palette: Float[Tensor, "K 3"] | None,
    settings: CamouflageSettings,
) -> UniversalTexture:
    fixed = name.constraints is not None and name.constraints.colours == "fixed"
    if fixed and palette is None:
        raise ConfigurationError(f"{name} expects fixed colours; give them with --palette.")
    return UniversalTexture(
        name,
        generator=generator,
        palette=palette if name.takes_palette else None,
        colours=settings.colours,
        blocks=settings.blocks,
    )
