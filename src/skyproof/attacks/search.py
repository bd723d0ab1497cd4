"""Controls without gradients: the best of many candidates, and a random search.

An optimised camouflage counts for what it hides beyond these, which a sceptic would try first.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.objective import Objective, objective
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import TrainableDetector

_FIRST_BATCHES = 2
_FINALISTS = 4
"""One candidate in four is tried on all scenes."""


def choose(
    candidates: Sequence[Camouflage],
    held_out: HeldOut,
    progress: Callable[[int, int], None],
) -> tuple[Camouflage, dict[str, Any]]:
    """Chooses the camouflage that hides most vehicles on held-out scenes, mean over detectors.

    All are tried on a quarter of the scenes, and the best quarter of them on all scenes. Of equals
    the one with the lower scores on its targets wins. `progress` is called with (candidates tried,
    candidates in all). Returns the best candidate, and the choice as JSON values.
    """
    first = []
    for number, candidate in enumerate(candidates):
        progress(number, len(candidates))
        first.append(held_out.measure(candidate, _FIRST_BATCHES))
    ranked = sorted(range(len(candidates)), key=lambda number: first[number], reverse=True)
    finalists = ranked[: math.ceil(len(candidates) / _FINALISTS)]
    final = {number: held_out.measure(candidates[number]) for number in finalists}
    names = [str(candidate.name) for candidate in candidates]
    return candidates[max(finalists, key=lambda number: final[number])], {
        "of": names,
        "hidden": [found.hidden for found in first],
        "scenes": held_out.scenes(_FIRST_BATCHES),
        "finalists": {names[number]: found.hidden for number, found in final.items()},
        "final_scenes": held_out.scenes(),
    }


@torch.no_grad()
def search_step(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    world: World,
    settings: AttackSettings,
    step: int,
) -> tuple[Objective, Float[Tensor, "B 3 H W"]]:
    """Tries one random change of a finished camouflage, and keeps it if the objective is lower.

    Both are tried on the same half of a batch, so that a search has as many forward passes as an
    attack of as many steps. Returns the objective with the kept camouflage, and its images.
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
