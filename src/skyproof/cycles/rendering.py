"""Which renderer a command draws with: options that several commands share. Imports no torch."""

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
        blender: for cycles: a Blender 4.5 executable, or a Python that has bpy 4.5. Where it is not
            given, what `make blender` made is used, then `blender` on the PATH.
        workers: for cycles: how many Blender processes, of one thread each; one per CPU core where
            it is not given.
        cycles: for cycles: how finely it draws.
    """

    renderer: Literal["torch", "cycles"] = "torch"
    blender: Path | None = None
    workers: Annotated[int, Meta(ge=1, le=1000)] | None = None
    cycles: CyclesSettings = field(default_factory=CyclesSettings)
