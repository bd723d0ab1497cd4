"""Detectors of a few steps whose threshold chance does not decide."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from skyproof.detectors.average_precision import PrecisionRecall, frozen_threshold
from skyproof.detectors.common import LOWEST_SCORE

__all__ = ["everything_counts"]


@contextmanager
def everything_counts() -> Iterator[None]:
    """Within it, training freezes the lowest threshold there is.

    The best F1 of a network that saw a few images is one lucky detection's. Its threshold may lie
    above all others, and then no success rate is defined on some machine or after some change.
    """

    def lowest(curve: PrecisionRecall) -> tuple[float, float]:
        return LOWEST_SCORE, frozen_threshold(curve)[1]

    with patch("skyproof.detectors.training.frozen_threshold", lowest):
        yield
