"""How a camouflage is optimised. Imports no torch, so that the command line answers at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import Count, Seed, check_ranges

_SEARCH_BATCH_SIZE = 8


@dataclass(frozen=True)
class AttackSettings:
    """How a camouflage is optimised; the paper gives none of these numbers.

    Attributes:
        steps: optimiser steps.
        batch_size: images, and so vehicles, a step; of as many images, few in many steps teach more
            (docs/attacks.md).
        learning_rate: Adam's at the start; half a cosine takes it to a tenth.
        balance_batches: batches, seen by no step, whose mean losses set the detectors' weights, and
            measure what the last rounding costs.
        keep_at: steps after which a finished copy is kept in `snapshots/`, to see an attack grow
            stronger; then also one from before the last rounding, "relaxed".
        preview_every: steps between pictures of the batch.
        checkpoint_every: steps between checkpoints.
        seed: decides all scenes and random draws.
    """

    steps: Count = 400
    batch_size: Annotated[int, Meta(ge=1, le=4096)] = 4
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 0.05
    balance_batches: Annotated[int, Meta(ge=1, le=1000)] = 4
    keep_at: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()
    preview_every: Count = 100
    checkpoint_every: Count = 25
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_ranges(self)
        if max(self.keep_at, default=0) > self.steps:
            raise ConfigurationError(
                f"keep_at expects steps of the attack, which has {self.steps}, got "
                f"{max(self.keep_at)}."
            )

    def of_search(self) -> AttackSettings:
        """Returns those of a random search: as many images, in steps of more.

        A step along the gradient of few images is right on average; a change that happens to help
        on few images is kept for good.
        """
        images = self.steps * self.batch_size
        batch_size = min(max(self.batch_size, _SEARCH_BATCH_SIZE), images)
        return replace(self, steps=images // batch_size, batch_size=batch_size, keep_at=())


@dataclass(frozen=True)
class QuerySettings:
    """How a camouflage is sought by a detector's answers alone.

    Attributes:
        images: how many the detector is shown at most.
        batch_size: images, and so vehicles, on which each candidate is tried; those of one
            generation are tried on the same.
        keep_at: numbers of images after which a finished copy is kept in `snapshots/`, to see what
            so many answers are worth.
        seed: decides scenes and candidates.
    """

    images: Annotated[int, Meta(ge=64, le=10**9)] = 6000
    batch_size: Annotated[int, Meta(ge=1, le=4096)] = 8
    keep_at: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_ranges(self)
