"""A tiny world with every kind of document, made once; tests put hostile ones in their place."""

from __future__ import annotations

import pytest

from tests.hostile.sandbox import Sandbox
from tests.hostile.world import make_world

_RAN: set[str] = set()


@pytest.fixture(scope="session")
def sandbox(tmp_path_factory: pytest.TempPathFactory) -> Sandbox:
    """The sandbox with the tiny world as its inputs."""
    place = Sandbox(tmp_path_factory.mktemp("hostile") / "root")
    make_world(place.inputs)
    return place


@pytest.fixture(scope="session")
def ran_here() -> set[str]:
    """The tests of this folder that ran in this process."""
    return _RAN


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts these tests first of all, because they take long, and their count last of them."""
    hostile = [item for item in items if "/hostile/" in item.nodeid]
    hostile.sort(key=lambda item: "test_summary" in item.nodeid)
    items[:] = [*hostile, *(item for item in items if "/hostile/" not in item.nodeid)]


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Notes what ran."""
    if report.when == "call" or report.skipped:
        _RAN.add(report.nodeid)
