"""How many hostile inputs were tried: at least 2,000 by `pytest tests/hostile`, in one process."""

import pytest

from tests.hostile.sandbox import RAN

pytestmark = pytest.mark.slow

FEWEST = 2000


def test_enough_were_tried(request: pytest.FixtureRequest, ran_here: set[str]) -> None:
    """Counts the examples, where all property tests ran in this process."""
    hostile = {item.nodeid for item in request.session.items if "/hostile/" in item.nodeid} - {
        request.node.nodeid
    }
    if not hostile <= ran_here or len(hostile) < 60:
        pytest.skip("the property tests did not all run in this process")
    assert sum(RAN.values()) >= FEWEST, dict(RAN)
