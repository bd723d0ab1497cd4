"""Detectors of a few steps whose threshold chance does not decide."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from skyproof.detectors.card import read_card, write_card
from skyproof.detectors.detector import LOWEST_SCORE
from skyproof.detectors.validation import PrecisionRecall, frozen_threshold

__all__ = ["count_everything", "everything_counts"]


@contextmanager
def everything_counts() -> Iterator[None]:
    """Within it, training freezes the lowest threshold there is.

    The best F1 of a network that saw a few images is one lucky detection's. Its threshold may lie
    above all others, and then no success rate is defined on some machine or after some change.
    """

    def lowest(curve: PrecisionRecall) -> tuple[float, float]:
        return LOWEST_SCORE, frozen_threshold(curve)[1]

    with patch("skyproof.detectors.validation.frozen_threshold", lowest):
        yield


def count_everything(folder: Path) -> None:
    """Gives a stored detector the lowest threshold there is.

    Its card keeps its age, so that nobody makes again what was made of it.
    """
    path = folder / "detector.json"
    written = path.stat()
    write_card(path, replace(read_card(folder), threshold=LOWEST_SCORE))
    os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns))
