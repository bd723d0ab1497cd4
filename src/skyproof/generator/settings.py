"""How vehicles are learnt from photographs.

Imports no torch, so that the command line answers at once.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.ranges import Checked, Seed

Method = Literal["layered", "gan"]
"""Layers between those of fitted vehicles; or a network that is trained on their maps."""

_Steps = Annotated[int, Meta(ge=1, le=10**6)]
_Count = Annotated[int, Meta(ge=1, le=1000)]


@dataclass(frozen=True)
class FitSettings(Checked):
    """How photographed vehicles are fitted.

    Attributes:
        bodies: number of drawn bodies of each type from which a fit may start.
        candidates: number of bodies nearest in size that are tried, each in both directions.
        choose_steps: steps of each candidate before the best is chosen.
        steps: further steps of the chosen candidate, with its texture.
    """

    bodies: _Count = 12
    candidates: _Count = 16
    choose_steps: _Steps = 12
    steps: _Steps = 60


@dataclass(frozen=True)
class AdversarialSettings(Checked):
    """How the network of the method gan is trained.

    Attributes:
        steps: number of optimiser steps of both networks.
        batch_size: maps per step.
        learning_rate: learning rate of the generator; the discriminator's is four times as high.
    """

    steps: _Steps = 4000
    batch_size: _Count = 16
    learning_rate: Annotated[float, Meta(gt=0, le=1)] = 2e-4


@dataclass(frozen=True)
class LearnSettings:
    """How a generator is learnt.

    Attributes:
        method: layered (between fitted vehicles) or gan (a network, as in the paper).
        seed: seed of the bodies, and of the network's weights and draws.
        fit: how vehicles are fitted.
        gan: how the network of gan is trained.
    """

    method: Method = "layered"
    seed: Suppress[Seed] = 0
    fit: Suppress[FitSettings] = field(default_factory=FitSettings)
    gan: Suppress[AdversarialSettings] = field(default_factory=AdversarialSettings)
