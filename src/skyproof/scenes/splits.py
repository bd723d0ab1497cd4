"""The four splits of ground, vehicles and scenes."""

from __future__ import annotations

__all__ = ["SPLITS"]


SPLITS = ("train", "validation", "attack", "test")
"""Disjoint in place: detectors train and choose thresholds on two, attacks train and are scored on two."""
