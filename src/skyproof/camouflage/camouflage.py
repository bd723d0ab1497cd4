"""What a camouflage is: a change of vehicles that can be optimised, finished and stored."""

import math
from collections.abc import Mapping

import torch
from torch import nn

from skyproof.camouflage.name import CamouflageName
from skyproof.vehicles.vehicle import VehicleBatch


class Camouflage(nn.Module):
    """Changes vehicles' texture or shape; an attack optimises its parameters.

    Attributes:
        name: as tables show it, such as "T-U" or "R-U-0".
        learning_rates: multiples of the attack's learning rate by parameter name.
    """

    name: CamouflageName
    learning_rates: Mapping[str, float] = {}

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """Returns the same vehicles, camouflaged; differentiable in the parameters."""
        raise NotImplementedError

    def paper_form_(self, on: bool) -> None:
        """Switches to the form that the paper's method optimises, or back to the stored one.

        Switching back changes no picture. A camouflage without a second form stays as it is.
        """

    def before_step_(self, step: int, steps: int) -> None:
        """Sets what depends on the attack's progress, such as a temperature, before each step."""

    def project_(self) -> None:
        """Moves the parameters back into their range; called after every optimiser step."""

    def vary_(self, generator: torch.Generator) -> None:
        """Changes a part of a finished camouflage at random, for a random search."""
        raise NotImplementedError

    def finalise(self) -> None:
        """Turns the camouflage into exactly what is stored, such as 8-bit colours, at the end."""


def random_part(size: int, *, generator: torch.Generator) -> tuple[slice, slice]:
    """Draws rows and columns of a map, each octave of length from size / 32 on equally often."""
    parts = []
    for octave, place in torch.rand(2, 2, generator=generator).tolist():
        length = min(size, max(1, round(size * 2 ** (-5 * octave))))
        start = math.floor(place * (size - length + 1))
        parts.append(slice(start, start + length))
    return parts[0], parts[1]
