"""The choice of a renderer: options that several commands share. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.cycles.settings import CyclesSettings


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """The differentiable renderer, or Blender's path tracer.

    Attributes:
        renderer: torch (the differentiable renderer) or cycles (Blender's path tracer).
        blender: Blender 4.5 executable, or Python with bpy 4.5, for cycles. The default is the one
            of `make blender`, then `blender` on the PATH.
        workers: number of Blender processes of one thread each, for cycles. The default is one per
            CPU core.
        cycles: quality settings of cycles.
    """

    renderer: Literal["torch", "cycles"] = "torch"
    blender: Path | None = None
    workers: Annotated[int, Meta(ge=1, le=1000)] | None = None
    cycles: CyclesSettings = field(default_factory=CyclesSettings)
