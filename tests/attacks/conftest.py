"""The detectors under attack, loaded once for every test that attacks them."""

from __future__ import annotations

import pytest

from tests.attacks.attacked import Attacked, make_attacked


@pytest.fixture(scope="session")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Attacked:
    """RetinaNet and Faster R-CNN; one file asks for them, and a file's tests share a process."""
    return make_attacked(tmp_path_factory.mktemp("attacked"))
