"""The choice of a renderer: options that several commands share. Imports no torch."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.cycles.settings import CyclesSettings


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """The differentiable renderer, or Blender's path tracer.

    Attributes:
        renderer: torch (the differentiable renderer) or cycles (Blender's path tracer).
        blender: Blender 4.5, or a Python with bpy 4.5 (default: of `make blender`, then of the
            PATH).
        workers: number of Blender processes of one thread each; None is one per CPU core.
        cycles: quality settings of cycles.
    """

    renderer: Literal["torch", "cycles"] = "torch"
    blender: Path | None = None
    workers: Suppress[Annotated[int, Meta(ge=1, le=1000)] | None] = None
    cycles: Suppress[CyclesSettings] = field(default_factory=CyclesSettings)
