"""How names are put together: a base, a variant ("_on_retinanet"), a repeat ("-2"); and whose control is whose."""

from __future__ import annotations

import re

__all__ = ["base_name", "is_control", "matched_control", "pooled_name", "variant_name"]

_REPEAT = re.compile(r"(.+)-\d+")
_COMBINED = re.compile(r"C-(.+)-(?:seq|par)(@.+)?")


def pooled_name(camouflage: str) -> str:
    """The row a camouflage belongs to: its name without the repeat, "T-U-1" to "T-U" (PAPER 25, 34).

    Repeats are attacks from several seeds, or several draws of a random control.
    """
    repeat = _REPEAT.fullmatch(camouflage)
    return repeat.group(1) if repeat else camouflage


def base_name(camouflage: str) -> str:
    """A name without repeat and variant, "T-U_on_retinanet-1" to "T-U"."""
    return pooled_name(camouflage).partition("_")[0]


def variant_name(camouflage: str, variant: str) -> str:
    """A name with one more variant, which stands before the repeat: "T-U-0" and "step10" to "T-U_step10-0"."""
    pooled = pooled_name(camouflage)
    return f"{pooled}_{variant}{camouflage.removeprefix(pooled)}"


def is_control(camouflage: str) -> bool:
    """Whether a camouflage is a random control: drawn, not learnt (PAPER 34)."""
    return camouflage.startswith("R-")


def matched_control(camouflage: str) -> str:
    """The random control of a camouflage: the same constraints without learning (PAPER 34).

    "T-PixMa" to "R-PixMa", "S-O@0.4" to "R-S-O@0.4", "C-Fc-seq@0.2" and "C-Fc-par@0.2" to "R-C-Fc@0.2". A variant (all
    from the first "_") has the control of its base, "T-U_on_retinanet" to "R-U"; repeats are dropped.
    """
    base = base_name(camouflage)
    combined = _COMBINED.fullmatch(base)
    if combined:
        return f"R-C-{combined.group(1)}{combined.group(2) or ''}"
    return "R-" + (base if base.startswith("S-") else base.partition("-")[2])
