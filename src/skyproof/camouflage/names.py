"""Names as strings, for tables that do not hold `CamouflageName` yet."""

from __future__ import annotations

from skyproof.camouflage.name import CamouflageName

__all__ = ["base_name", "is_control", "matched_control", "pooled_name"]


def pooled_name(camouflage: str) -> str:
    """The name without its repeat."""
    return str(CamouflageName.read(camouflage).pooled)


def base_name(camouflage: str) -> str:
    """The name without variant and repeat."""
    return str(CamouflageName.read(camouflage).base)


def is_control(camouflage: str) -> bool:
    """Whether it is a random control."""
    return CamouflageName.read(camouflage).random


def matched_control(camouflage: str) -> str:
    """The name of its random control."""
    return str(CamouflageName.read(camouflage).control)
