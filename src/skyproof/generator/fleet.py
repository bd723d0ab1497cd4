"""Fleets whose vehicles a generator draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from skyproof.generator.sample import Sample, VehicleGenerator
from skyproof.vehicles.fleet import Fleet, FleetSettings, exact_share
from skyproof.vehicles.template import make_template


def sample_learnt_fleet(
    vehicles: VehicleGenerator,
    settings: FleetSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> Fleet:
    """Draws a fleet like any other: every camouflage, mask, renderer and table takes it.

    Args:
        vehicles: what `load_generator` gives.
        settings: how many, the number of the first, and which shares wear random patterns and
            shapes. Body types and other paints are the generator's own.
        generator: CPU generator; the same state gives the same fleet, byte for byte.
        progress: called with (vehicles done, vehicles in all).
    """
    samples = []
    for number in range(settings.count):
        samples.append(vehicles.sample(generator))
        if progress is not None:
            progress(number + 1, settings.count)
    fleet = fleet_of(samples, vehicles.method, settings.first_number)
    for index in exact_share(settings.paints.patterned, settings.count, generator):
        fleet.sources[fleet.ids[index]]["coat"] = "patterned"
    for index in exact_share(settings.shapes, settings.count, generator):
        fleet.sources[fleet.ids[index]]["shape"] = "random"
    return fleet


def fleet_of(samples: Sequence[Sample], method: str, first_number: int = 0) -> Fleet:
    """Makes a fleet of samples.

    Args:
        samples: by one generator.
        method: its kind.
        first_number: number of the first vehicle.
    """
    ids = tuple(
        f"{sample.body_type}-{number:04d}" for number, sample in enumerate(samples, first_number)
    )
    sources = {name: {"generator": method} for name in ids}
    return Fleet(
        None,
        make_template(),
        ids,
        torch.stack([sample.vertices for sample in samples]),
        torch.stack([sample.texture for sample in samples]),
        torch.stack([sample.parts for sample in samples]),
        sources,
    )
