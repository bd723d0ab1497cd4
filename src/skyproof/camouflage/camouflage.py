"""What a camouflage is: a change of vehicles that can be learnt, finished and stored."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import nn

from skyproof.camouflage.name import CamouflageName
from skyproof.vehicles.vehicle import VehicleBatch


class Camouflage(nn.Module):
    """Changes vehicles' texture or shape; its parameters, if any, are what an attack optimises.

    Attributes:
        name: "T-U", "R-U-0": as tables show it.
        learning_rates: multiples of the attack's learning rate by parameter name, where not 1.
    """

    name: CamouflageName
    learning_rates: Mapping[str, float] = {}

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """Gives the same vehicles, camouflaged; differentiable in the parameters."""
        raise NotImplementedError

    def before_step_(self, step: int, steps: int) -> None:
        """Sets what depends on an attack's progress, such as a temperature.

        Called before each step, from 1 to `steps`.
        """

    def project_(self) -> None:
        """Puts the parameters back into what is allowed; called after every optimiser step."""

    def vary_(self, generator: torch.Generator) -> None:
        """Changes a part at random, by what a random search tries next; finished ones alone.

        Args:
            generator: on the CPU.
        """
        raise NotImplementedError

    def finalise(self) -> None:
        """Makes the camouflage exactly what is stored and shown, such as colours of 8 bits.

        Called once at the end.
        """


def random_part(size: int, *, generator: torch.Generator) -> tuple[slice, slice]:
    """Draws a rectangle of a square map: from a thirty-second of a side to all of it, each octave
    of width and of height equally often.

    Args:
        size: of a side, in cells.
        generator: on the CPU.

    Returns:
        Its rows and its columns.
    """
    parts = []
    for octave, place in torch.rand(2, 2, generator=generator).tolist():
        length = min(size, max(1, round(size * 2 ** (-5 * octave))))
        start = math.floor(place * (size - length + 1))
        parts.append(slice(start, start + length))
    return parts[0], parts[1]
