"""The four splits of ground, vehicles and scenes."""

from typing import Literal, get_args

Split = Literal["train", "validation", "attack", "test"]

SPLITS: tuple[Split, ...] = get_args(Split)
"""Disjoint in place: two to train detectors and choose thresholds, two for attacks."""
