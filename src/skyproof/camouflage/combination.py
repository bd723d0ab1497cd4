"""Texture and shape together, one after the other or in turns (section 3.5)."""

from collections.abc import Mapping

import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.vehicles.vehicle import VehicleBatch


class Combination(Camouflage):
    """A texture and a displacement map on the same vehicles.

    Differences from the paper: masked textures may be combined too, because texture, part map and
    displacement share one UV map.

    Attributes:
        turn_steps: steps after which a parallel attack changes sides (the paper's n_pll). None is
            sequential: the texture stays and the attack optimises the shape alone.
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
        self.learning_rates: Mapping[str, float] = {
            f"{side}.{parameter}": rate
            for side, part in (("texture", texture), ("shape", shape))
            for parameter, rate in part.learning_rates.items()
        }

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        return self.shape(self.texture(vehicles))

    def before_step_(self, step: int, steps: int) -> None:
        """Says whose turn it is to be learnt; the texture begins."""
        if self.turn_steps is not None:
            texture_turn = (step - 1) // self.turn_steps % 2 == 0
            self.texture.requires_grad_(texture_turn)
            self.shape.requires_grad_(not texture_turn)
            self.texture.before_step_(step, steps)
        self.shape.before_step_(step, steps)

    def project_(self) -> None:
        if self.turn_steps is not None:
            self.texture.project_()
        self.shape.project_()

    def vary_(self, generator: torch.Generator) -> None:
        """Changes texture or shape, each as often."""
        part = self.texture if torch.rand((), generator=generator) < 0.5 else self.shape
        part.vary_(generator)

    def finalise(self) -> None:
        self.texture.finalise()
        self.shape.finalise()
