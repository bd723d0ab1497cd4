"""Photographs and fits that several tests look at."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyproof.generator.fits import Fit, FittedVehicles, Prototype, draw_prototypes, fitted_vehicles
from tests.generator.made_fits import made_fits
from tests.generator.photographs import Photographs, take_photographs

TYPES = ["saloon", "hatchback", "estate", "suv", "pickup", "van"]


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    """Nine vehicles on one tile."""
    folder: Path = tmp_path_factory.mktemp("photographs")
    return take_photographs(folder, 9)


@pytest.fixture(scope="session")
def prototypes() -> list[Prototype]:
    """Some bodies of every type."""
    return draw_prototypes(TYPES, 6, 0)


@pytest.fixture(scope="session")
def fits(prototypes: list[Prototype]) -> list[Fit]:
    """Fits that nobody made of pictures."""
    return made_fits(prototypes, 24)


@pytest.fixture(scope="session")
def fitted(fits: list[Fit], prototypes: list[Prototype]) -> FittedVehicles:
    """What a generator learns from."""
    return fitted_vehicles(fits, prototypes)
