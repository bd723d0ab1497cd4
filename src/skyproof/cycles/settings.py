"""What the path tracer can be told beside light and sensor. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import check_ranges


@dataclass(frozen=True)
class CyclesSettings:
    """How finely crops are path-traced, and what camouflage is painted with.

    Attributes:
        samples: light paths per pixel; 32 in bulk, 64 for final pictures. The sensor's blur
            averages the noise of some 70 pixels.
        finish: camouflage paint under the vehicle's clear coat (gloss), or without one (matt).
        margin_m: how far a crop reaches beyond the vehicle and its cast shadow, in metres, because
            the vehicle hides a part of the sky from the ground around it; the rest of that effect
            fades out towards the crop's edge.
    """

    samples: Annotated[int, Meta(ge=1, le=65_536)] = 32
    finish: Literal["gloss", "matt"] = "gloss"
    margin_m: Annotated[float, Meta(ge=0, le=100)] = 1.0

    def __post_init__(self) -> None:
        check_ranges(self)
