"""Blender processes that the tests of this folder share."""

from collections.abc import Iterator

import pytest

from skyproof.cycles.blender import Blender, find_blender
from skyproof.cycles.workers import Workers
from skyproof.errors import ConfigurationError


@pytest.fixture(scope="session")
def blender() -> Blender:
    """The Blender of this checkout; tests that need it are skipped where there is none."""
    try:
        return find_blender()
    except ConfigurationError as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def workers(blender: Blender) -> Iterator[Workers]:
    """One process for all tests, since each takes seconds to start."""
    with Workers(blender, 1) as made:
        yield made
