"""The trained detectors, made once for every test that attacks them."""

from __future__ import annotations

import pytest

from tests.attacks.trained import Trained, make_trained


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """RetinaNet and Faster R-CNN; one file asks for them, and a file's tests share a process."""
    return make_trained(tmp_path_factory.mktemp("trained"))
