"""Fleets whose vehicles a generator draws."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.vehicles.fleet import Fleet, FleetSettings, exact_share


@dataclass(frozen=True)
class LearntVehicle:
    """A vehicle on the shared template; its body type stands before the last hyphen of its id."""

    body_type: str
    vertices: Float[Tensor, "V 3"]
    texture: UInt8[Tensor, "3 512 512"]
    parts: UInt8[Tensor, "512 512"]


@runtime_checkable
class VehicleGenerator(Protocol):
    """Draws vehicles like those it learnt from; `method` is its name in a folder."""

    method: str

    def sample(self, generator: torch.Generator) -> LearntVehicle:
        """Draws a vehicle; the same state of the generator gives the same one."""
        ...


def sample_learnt_fleet(
    vehicles: VehicleGenerator,
    settings: FleetSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Fleet:
    """Draws a fleet that every camouflage, mask, renderer and table takes like any other.

    Body types and paints are the generator's own; the settings add random patterns and shapes. The
    same state of the CPU generator gives the same fleet, byte for byte.
    """
    drawn = {}
    for number in range(settings.count):
        one = vehicles.sample(generator)
        name = f"{one.body_type}-{settings.first_number + number:04d}"
        drawn[name] = (one.vertices, one.texture, one.parts)
        progress(number + 1, settings.count)
    fleet = Fleet.of(drawn, {name: {"generator": vehicles.method} for name in drawn})
    for index in exact_share(settings.paints.patterned, settings.count, generator):
        fleet.sources[fleet.ids[index]]["coat"] = "patterned"
    for index in exact_share(settings.shapes, settings.count, generator):
        fleet.sources[fleet.ids[index]]["shape"] = "random"
    return fleet
