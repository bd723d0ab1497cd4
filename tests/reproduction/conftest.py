"""What the tests of the paper's tables share."""

import numpy as np
import pytest

from tests.results.conftest import make_scene as make_scene


@pytest.fixture
def rng():
    return np.random.default_rng(7)
