"""Settings of the path tracer, and the choice of a renderer. Imports no torch."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.ranges import Checked


@dataclass(frozen=True)
class CyclesSettings(Checked):
    """How finely crops are path-traced, and the finish of the camouflage paint.

    Attributes:
        samples: light paths per pixel; 32 in bulk, 64 for final pictures. The sensor's blur
            averages the noise of about 70 pixels.
        finish: camouflage paint under the vehicle's clear coat (gloss), or without one (matt).
        margin_m: reach of a crop beyond the vehicle and its cast shadow, in metres; the vehicle
            hides a part of the sky from this ground, and the rest of that effect fades out towards
            the crop's edge.
    """

    samples: Annotated[int, Meta(ge=1, le=65_536)] = 32
    finish: Literal["gloss", "matt"] = "gloss"
    margin_m: Annotated[float, Meta(ge=0, le=100)] = 1.0


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
