"""What the path tracer can be told beside light and sensor, which it shares with the differentiable renderer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from skyproof.errors import ConfigurationError

__all__ = ["CyclesSettings"]


@dataclass(frozen=True)
class CyclesSettings:
    """How finely crops are path-traced, and what camouflage is painted with.

    Attributes:
        samples: light paths per pixel; the sensor's blur averages some 70 pixels' noise.
        finish: camouflage under the vehicle's clear coat ("gloss"), or without one ("matt").
        margin_m: how far beyond vehicle and cast shadow a crop reaches, for the sky that the vehicle hides from the
            ground; what is left of that fades out towards the crop's edge.
    """

    samples: int = 32
    finish: Literal["gloss", "matt"] = "gloss"
    margin_m: float = 1.0

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ConfigurationError(
                f"--samples expects at least 1 light path per pixel, got {self.samples}."
            )
        if self.finish not in ("gloss", "matt"):
            raise ConfigurationError(f"--finish expects gloss or matt, got {self.finish}.")
