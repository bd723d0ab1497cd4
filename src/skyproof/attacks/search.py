"""What can be had without a gradient: the best of many unlearnt camouflages, and random search.

A camouflage that was learnt is worth no more than what it has over these: a sceptic would try them
first.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.objective import Objective, objective
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.errors import ConfigurationError

_FIRST_BATCHES = 2
_FINALISTS = 4
"""One candidate in so many is shown all scenes."""


@dataclass(frozen=True)
class Chosen:
    """The best of some camouflages on scenes that no attack step sees.

    Attributes:
        camouflage: the one that hides most.
        hidden: per candidate its EASR, mean over the detectors, on the first scenes.
        scenes: how many these are.
        finalists: by the number of the candidate, the EASR of those that were shown all scenes.
        final_scenes: how many these are.
    """

    camouflage: Camouflage
    hidden: tuple[float, ...]
    scenes: int
    finalists: dict[int, float]
    final_scenes: int


def choose(
    candidates: Sequence[Camouflage],
    held_out: HeldOut,
    *,
    on_candidate: Callable[[int], None] | None = None,
) -> Chosen:
    """Chooses the camouflage that hides most vehicles of held-out scenes, mean over detectors.

    All are shown a quarter of the scenes; the best quarter of them, all scenes. Of equals it is the
    one with the lower scores on its targets.

    Args:
        candidates: at least one, on the device to work on.
        held_out: the scenes, and the detectors that judge there.
        on_candidate: called with the number of every candidate before it is shown the first scenes.

    Raises:
        ConfigurationError: no candidate, or a detector finds no vehicle of these scenes.
    """
    if not candidates:
        raise ConfigurationError("Expected at least one camouflage to choose from; give some.")
    first = []
    for number, candidate in enumerate(candidates):
        if on_candidate is not None:
            on_candidate(number)
        first.append(held_out.judge(candidate, _FIRST_BATCHES))
    ranked = sorted(range(len(candidates)), key=lambda number: first[number], reverse=True)
    finalists = ranked[: math.ceil(len(candidates) / _FINALISTS)]
    final = {number: held_out.judge(candidates[number]) for number in finalists}
    best = max(finalists, key=lambda number: final[number])
    return Chosen(
        candidates[best],
        tuple(judged.hidden for judged in first),
        held_out.scenes(_FIRST_BATCHES),
        {number: judged.hidden for number, judged in final.items()},
        held_out.scenes(),
    )


@torch.no_grad()
def search_step(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    world: World,
    settings: AttackSettings,
    step: int,
) -> tuple[Objective, Float[Tensor, "B 3 H W"]]:
    """Tries one random change, and keeps it if the attack's own objective is lower with it.

    Both are shown to the detectors on the same half of a batch, so that a search of as many steps
    as an attack has as many forward passes.

    Args:
        camouflage: finished; changed where it lies.
        detectors: frozen, on its device.
        weights: of each detector's loss, by name.
        world: what an attack sees.
        settings: batch size and seed.
        step: decides scenes and change.

    Returns:
        The objective with the camouflage that is kept, and its images.
    """
    scenes = world.step_scenes(max(1, settings.batch_size // 2), settings.seed, step)
    other = copy.deepcopy(camouflage)
    other.vary_(torch.Generator().manual_seed((settings.seed * 1_000_033 + step) % 2**63))
    found = []
    for each in (camouflage, other):
        images = world.frames(each, scenes).image
        found.append((objective(detectors, weights, images), images))
    before, after = found
    if after[0].loss < before[0].loss:
        camouflage.load_state_dict(other.state_dict())
        return after
    return before
