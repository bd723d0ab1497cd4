"""How a camouflage is optimised. Imports no torch, so that the command line answers at once."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.ranges import Checked, Count, Seed, check_ranges

Method = Literal["skyproof", "paper"]
"""How an attack optimises: as skyproof does, or as the paper's text says."""

_SEARCH_BATCH_SIZE = 8
_PLAIN_PAINTS = 27
_CHOICE_SCENES = 32
"""Mean number per candidate: all are tried on 16, the best quarter of them on 64 more."""
_WITHOUT_GRADIENT = 0.4


@dataclass(frozen=True)
class AttackSettings:
    """How a camouflage is optimised; the paper gives none of these numbers.

    The method "paper" minimises the weighted sum of the losses (section 3.2), whose terms are equal
    on vehicles in the camouflage as it starts. Few colours are mixed by s(s(p)), and a softmax of p
    follows every step (section S4.2.3). Shapes are a sigmoid (section S4.3). Optimised colours
    start anywhere. A search control has the same objective.

    Differences from the paper, also in its method: Adam, with one learning rate for all parameters
    and the usual schedule. τ is 0.5. The weights are computed, as those of table S2 suit losses
    that are not normalised. Displacements follow rays (see `DisplacementMap`).

    Attributes:
        method: skyproof, or paper (as the paper's text has it).
        steps: optimiser steps.
        batch_size: images (vehicles) per step; many small steps are better than few large ones
            (docs/attacks.md).
        learning_rate: learning rate of Adam at the start; half a cosine takes it to a tenth.
        balance_batches: batches of no step, whose mean losses set the detectors' weights and
            measure the cost of the last rounding.
        keep_at: steps after which a finished copy is kept in `snapshots/`.
        preview_every: steps between pictures of the batch.
        checkpoint_every: steps between checkpoints.
        seed: seed of all scenes and random draws.
    """

    method: Method = "skyproof"
    steps: Count = 400
    batch_size: Suppress[Annotated[int, Meta(ge=1, le=4096)]] = 4
    learning_rate: Suppress[Annotated[float, Meta(gt=0, le=10)]] = 0.05
    balance_batches: Suppress[Annotated[int, Meta(ge=1, le=1000)]] = 4
    keep_at: Suppress[Annotated[tuple[Count, ...], Meta(max_length=1000)]] = ()
    preview_every: Suppress[Count] = 100
    checkpoint_every: Suppress[Count] = 25
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_ranges(self)
        if max(self.keep_at, default=0) > self.steps:
            raise ConfigurationError(
                f"keep_at expects steps of the attack, which has {self.steps}, got "
                f"{max(self.keep_at)}."
            )

    def takes_palette(self, name: CamouflageName) -> bool:
        """Whether a camouflage takes the palette; by the paper's method only fixed colours do."""
        fixed = name.constraints is not None and name.constraints.colours == "fixed"
        return name.takes_palette and (fixed or self.method == "skyproof")

    def images(self, name: CamouflageName, best_of: int) -> float:
        """Images per detector of an attack or chosen control; one without gradient counts 0.4."""
        if name.has_candidates:
            candidates = _PLAIN_PAINTS if name.choice == "plain" else best_of
            return _WITHOUT_GRADIENT * _CHOICE_SCENES * candidates
        return self.steps * self.batch_size * (_WITHOUT_GRADIENT if name.choice else 1.0)

    def of_search(self) -> "AttackSettings":
        """The settings of a random search: as many images, in larger steps that need less luck."""
        images = self.steps * self.batch_size
        batch_size = min(max(self.batch_size, _SEARCH_BATCH_SIZE), images)
        return replace(self, steps=images // batch_size, batch_size=batch_size, keep_at=())


@dataclass(frozen=True)
class QuerySettings(Checked):
    """How a query attack optimises a camouflage.

    Attributes:
        images: budget, the largest number of images shown to the detector.
        batch_size: images (vehicles) per candidate; candidates of one generation share them.
        keep_at: numbers of images after which a finished copy is kept in `snapshots/`.
        seed: seed of scenes and candidates.
    """

    images: Annotated[int, Meta(ge=64, le=10**9)] = 6000
    batch_size: Annotated[int, Meta(ge=1, le=4096)] = 8
    keep_at: Annotated[tuple[Count, ...], Meta(max_length=1000)] = ()
    seed: Seed = 0
