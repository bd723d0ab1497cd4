"""Fleets for every split, however their vehicles are drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from skyproof.console import progress_bar, say
from skyproof.files import finished_folder
from skyproof.scenes.splits import SPLITS
from skyproof.vehicles.settings import CATALOGUE_PAINTS, VehicleCount

if TYPE_CHECKING:
    from skyproof.vehicles.fleet import Fleet, FleetSettings

FleetCounts = tuple[VehicleCount, VehicleCount, VehicleCount, VehicleCount]
"""Vehicles of train, validation, attack and test."""


def draw_fleets(
    out: Path,
    counts: FleetCounts,
    settings: FleetSettings,
    seed: int,
    sample: Callable[..., Fleet],
) -> None:
    """Writes the four fleets train, validation, attack and test; all of them or nothing.

    Args:
        settings: first number, and paints and shapes of train and validation; attack and test have
            catalogue paints and their own shapes.
    """
    from skyproof.camouflage.random_controls import wear_random_controls
    from skyproof.randomness import generator_of

    with finished_folder(out) as folder:
        # Numbers go on from split to split: no vehicle is in two of them.
        first_number = settings.first_number
        for split, count in zip(SPLITS, counts, strict=True):
            chosen = replace(settings, count=count, first_number=first_number)
            if split not in ("train", "validation"):
                chosen = replace(chosen, paints=CATALOGUE_PAINTS, shapes=0.0)
            with progress_bar(f"vehicles {split}") as update:
                generator = generator_of(seed, "fleet", split)
                fleet = sample(chosen, generator=generator, progress=update)
            controls = generator_of(seed, "controls", split)
            wear_random_controls(fleet, generator=controls).save(folder / split)
            first_number += count
    say(f"Fleets of {', '.join(map(str, counts))} vehicles: {out.resolve()}")
