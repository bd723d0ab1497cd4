"""How a camouflage is optimised. Imports no torch, so that the command line answers at once."""

from __future__ import annotations

from dataclasses import dataclass

from skyproof.errors import ConfigurationError

__all__ = ["AttackSettings"]


@dataclass(frozen=True)
class AttackSettings:
    """How a camouflage is optimised; the paper gives none of these numbers.

    Attributes:
        steps: optimiser steps.
        batch_size: images, and so vehicles, a step.
        learning_rate: Adam's at the start; half a cosine takes it to a tenth.
        balance_batches: batches, seen by no step, whose mean losses set the detectors' weights, and
            measure what the last rounding costs.
        keep_at: steps after which a finished copy is kept in `snapshots/`, to see an attack grow
            stronger; then also one from before the last rounding, "relaxed".
        preview_every: steps between pictures of the batch.
        checkpoint_every: steps between checkpoints.
        seed: decides all scenes and random draws.
    """

    steps: int = 300
    batch_size: int = 8
    learning_rate: float = 0.05
    balance_batches: int = 4
    keep_at: tuple[int, ...] = ()
    preview_every: int = 100
    checkpoint_every: int = 25
    seed: int = 0

    def __post_init__(self) -> None:
        if (
            min(
                self.steps,
                self.batch_size,
                self.balance_batches,
                self.preview_every,
                self.checkpoint_every,
            )
            < 1
        ):
            raise ConfigurationError(f"An attack expects counts of at least 1, but got {self}.")
        if not self.learning_rate > 0:
            raise ConfigurationError(
                f"An attack expects a learning rate above 0, but got {self.learning_rate}."
            )
