"""The small world, made once."""

import pytest
import torch

from skyproof.measure.precheck import PrecheckScenes, precheck
from tests.measure.world import Toy, judging, make_backgrounds, make_fleet, make_scenes
from tests.results.conftest import make_detections, make_scene, rng  # noqa: F401


@pytest.fixture(scope="session")
def fleet():
    return make_fleet()


@pytest.fixture(scope="session")
def backgrounds(tmp_path_factory):
    return make_backgrounds(tmp_path_factory.mktemp("gate") / "ground")


@pytest.fixture(scope="session")
def scenes(backgrounds, fleet):
    return make_scenes(backgrounds, fleet)


def is_yellow(red, green, blue):
    return min(red, green) - blue > 0.2 and abs(red - green) < 0.1


@pytest.fixture(scope="session")
def good(scenes, fleet):
    """A detector that finds everything; `records` has it checked."""
    return Toy("good", scenes, fleet)


@pytest.fixture(scope="session")
def records(backgrounds, fleet, scenes, good):
    """What the precheck says of a detector that finds everything, and of one blind to yellow."""
    blind = Toy("blind", scenes, fleet, is_yellow)
    judges = [judging(good), judging(blind)]
    data = PrecheckScenes(backgrounds, fleet, scenes, draws=2, frames=[], seed=0)
    made = precheck(judges, data, device=torch.device("cpu"))
    return {record.detector: record for record in made}
