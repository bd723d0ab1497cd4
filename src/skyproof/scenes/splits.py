"""The four splits of ground, vehicles and scenes."""

from __future__ import annotations

__all__ = ["SPLITS"]


SPLITS = ("train", "validation", "attack", "test")
"""Disjoint in place: two are for training detectors and choosing thresholds, two for attacks."""
