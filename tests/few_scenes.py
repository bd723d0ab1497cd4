"""Commands that judge what they learn on few scenes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

__all__ = ["few_scenes_judge"]


@contextmanager
def few_scenes_judge() -> Iterator[None]:
    """Within it, commands judge attacks and choices on eight batches of the attack's own size.

    Eight scenes each would take more than half of a tiny run's time. `HeldOut` itself, as
    tests/attacks asks it, keeps its 64 scenes.
    """
    with patch("skyproof.attacks.held_out.BATCH_SIZE", 1):
        yield
