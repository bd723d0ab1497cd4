"""Camouflages from their names: "T-PixFcMa", "S-O@0.4", "C-Fc-par@0.2", "R-PixFcMa"."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap, even_shape
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.paint import LATTICE, plain_paint
from skyproof.camouflage.patterns import PATTERNS, draw_pattern
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError
from skyproof.randomness import generator_of
from skyproof.vehicles.vehicle import VehicleBatch


class Combination(Camouflage):
    """A texture and a displacement map on the same vehicles.

    Differences from the paper: masked textures may be combined too, as all share one UV map.
    `turn_steps` is the paper's n_pll, after which a parallel attack changes sides; None is
    sequential: the texture stays.
    """

    def __init__(
        self,
        name: CamouflageName,
        texture: UniversalTexture,
        shape: DisplacementMap,
        *,
        turn_steps: int | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.texture = texture
        self.shape = shape
        self.turn_steps = turn_steps
        if turn_steps is None:
            texture.requires_grad_(False)
        self.learning_rates = {
            f"{side}.{parameter}": rate
            for side, part in (("texture", texture), ("shape", shape))
            for parameter, rate in part.learning_rates.items()
        }

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        return self.shape(self.texture(vehicles))

    def paper_form_(self, on: bool) -> None:
        self.texture.paper_form_(on)
        self.shape.paper_form_(on)

    def before_step_(self, step: int, steps: int) -> None:
        """Sets which part is optimised in this step; the texture begins."""
        if self.turn_steps is not None:
            texture_turn = (step - 1) // self.turn_steps % 2 == 0
            self.texture.requires_grad_(texture_turn)
            self.shape.requires_grad_(not texture_turn)
            self.texture.before_step_(step, steps)
        self.shape.before_step_(step, steps)

    def project_(self) -> None:
        # By the paper's method, a softmax in the shape's turns would wash out the texture.
        if self.texture.cells.requires_grad:
            self.texture.project_()
        self.shape.project_()

    def vary_(self, generator: torch.Generator) -> None:
        """Changes the texture or the shape, each equally often."""
        part = self.texture if torch.rand((), generator=generator) < 0.5 else self.shape
        part.vary_(generator)

    def finalise(self) -> None:
        self.texture.finalise()
        self.shape.finalise()


def make_camouflage(
    name: str | CamouflageName,
    *,
    generator: torch.Generator,
    palette: Float[Tensor, "K 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> Camouflage:
    """Makes a camouflage from its name: at the start of its attack, or finished if it is random.

    Args:
        name: such as "T-PixFcMa", "S-O@0.4", "C-Fc-seq@0.2" or "R-PixFc", whatever its variant and
            repeat.
        generator: on the CPU.
        palette: `[K, 3]` sRGB in [0, 1], for fixed colours (Fc) and as the start of optimised ones.
        texture: finished texture, or a combination with one, under the shape of a sequential
            combination or of a random shape on an attack's own texture.
        settings: numbers that the name leaves open.

    Raises:
        ConfigurationError: no such name, or palette or texture are missing or do not fit.
    """
    name = CamouflageName.parse(name) if isinstance(name, str) else name
    settings = settings or CamouflageSettings()
    if name.kind == "other":
        raise ConfigurationError(
            f"{name} names no camouflage that can be made; see skyproof attack --help."
        )
    made: Camouflage
    if name.kind == "texture":
        made = _texture(name, generator, palette, settings)
    elif name.kind == "shape":
        made = _shape(name, generator)
    elif name.order == "seq" or (name.order == "par" and name.random):
        made = Combination(name, _finished(texture, name), _shape(name, generator))
    else:
        under = _texture(name, generator, palette, settings)
        turns = None if name.random else settings.turn_steps
        made = Combination(name, under, _shape(name, generator), turn_steps=turns)
    if name.random:
        made.finalise()
    return made


def draw_control(name: CamouflageName, *, seed: int, **given: Any) -> Camouflage:
    """Draws a random control, such as "R-PixFc-3"; `given` is passed to `make_camouflage`."""
    return make_camouflage(name, generator=generator_of(seed, "control", str(name)), **given)


def make_candidates(
    name: CamouflageName, draws: int, *, seed: int, **given: Any
) -> list[Camouflage]:
    """Makes a chosen control's candidates: plain paints, even shape, random draws or patterns."""
    if name.choice == "pattern":
        if name.constraints is None or given["palette"] is None:
            raise ConfigurationError(f"{name} expects colours; give them with --palette.")
        palette, masked = given["palette"], name.constraints.masked
        return [
            draw_pattern(PATTERNS[kind], palette, seed=seed, draw=draw, masked=masked)
            for draw, kind in (divmod(number, len(PATTERNS)) for number in range(draws))
        ]
    if name.choice == "best":
        names = [name.base.with_repeat(draw) for draw in range(draws)]
        return [draw_control(each, seed=seed, **given) for each in names]
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
    given = palette if name.takes_palette else None
    return UniversalTexture(
        name, generator=generator, palette=given, colours=settings.colours, blocks=settings.blocks
    )
