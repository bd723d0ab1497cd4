"""What a camouflage is: a change of vehicles that can be learnt, finished and stored."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["Camouflage", "NoCamouflage"]


class Camouflage(nn.Module):
    """Changes vehicles' texture or shape. Its parameters, if any, are what an attack optimises.

    Attributes:
        name: "T-U", "R-U-0", "none": as tables show it.
        learning_rates: parameter name to a multiple of the attack's learning rate, where it is not 1.
    """

    name: str
    learning_rates: Mapping[str, float] = {}

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """The same vehicles, camouflaged; differentiable in the parameters."""
        raise NotImplementedError

    def before_step_(self, step: int, steps: int) -> None:
        """Sets what depends on the progress of an attack, such as a temperature; called before step 1 to `steps`."""

    def project_(self) -> None:
        """Puts the parameters back into what is allowed; called after every optimiser step."""

    def finalise(self) -> None:
        """Makes the camouflage exactly what is stored and shown, such as colours of 8 bits; called once at the end."""


class NoCamouflage(Camouflage):
    """Vehicles as they are."""

    name = "none"

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """The vehicles themselves."""
        return vehicles
