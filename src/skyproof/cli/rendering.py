"""Which renderer a command draws with: options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

__all__ = ["Rendering"]


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """The differentiable renderer, or Blender's path tracer.

    Attributes:
        renderer: torch (the differentiable renderer) or cycles (Blender's path tracer).
        blender: for cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not given, what
            `make blender` made, then `blender` on the PATH.
        samples: for cycles: light paths per pixel; 32 in bulk, 64 for final pictures.
        finish: for cycles: camouflage paint under the vehicle's clear coat (gloss), or without (matt).
        workers: for cycles: Blender processes, of one thread each; one per CPU core where not given.
    """

    renderer: Literal["torch", "cycles"] = "torch"
    blender: Path | None = None
    samples: int = 32
    finish: Literal["gloss", "matt"] = "gloss"
    workers: int | None = None
