"""What a camouflage is: a change of vehicles that can be learnt, finished and stored."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from skyproof.camouflage.name import CamouflageName
from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["Camouflage"]


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

    def finalise(self) -> None:
        """Makes the camouflage exactly what is stored and shown, such as colours of 8 bits.

        Called once at the end.
        """
