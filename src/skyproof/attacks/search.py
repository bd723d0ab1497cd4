"""What can be had without a gradient: the best of many unlearnt camouflages, and random search.

A camouflage that was learnt is worth no more than what it has over these: a sceptic would try them
first.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks.objective import empty_truth_losses, target_scores
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import LoadedDetector
from skyproof.errors import ConfigurationError
from skyproof.scenes.scene import Scene

__all__ = ["Chosen", "choose", "search_step"]

_BATCHES = 8


@dataclass(frozen=True)
class Chosen:
    """The best of some camouflages on scenes that no attack step sees.

    Attributes:
        camouflage: the one that hides most.
        hidden: per candidate the EASR there, mean over the detectors, in the order of candidates.
        scenes: how many they were judged on.
    """

    camouflage: Camouflage
    hidden: tuple[float, ...]
    scenes: int


@torch.no_grad()
def choose(
    candidates: Iterable[Camouflage],
    detectors: Sequence[LoadedDetector[TrainableDetector]],
    world: AttackWorld,
    settings: AttackSettings,
) -> Chosen:
    """Chooses the camouflage that hides most vehicles of the attack's world, mean over detectors.

    Of equals it is the one with the lower scores on its targets. The scenes are those that no step
    of an attack sees.

    Args:
        candidates: at least one, on the device to work on.
        detectors: on the same device, with the thresholds that count.
        world: what an attack sees; it has one vehicle an image.
        settings: batch size and seed of the scenes.

    Raises:
        ConfigurationError: no candidate, or a detector finds no vehicle of these scenes.
    """
    batches = [
        world.step_scenes(settings.batch_size, settings.seed, -batch) for batch in range(_BATCHES)
    ]
    before: dict[str, int] = {}
    best: Camouflage | None = None
    rank = (-float("inf"), -float("inf"))
    hidden = []
    for candidate in candidates:
        scores = _scores(candidate, detectors, world, batches)
        before = before or _found_bare(detectors, world, batches)
        left = [
            float((scores[each.name] >= each.threshold).sum()) / before[each.name]
            for each in detectors
        ]
        easr = 1 - sum(left) / len(left)
        own_rank = (easr, -float(torch.stack(list(scores.values())).mean()))
        hidden.append(easr)
        if own_rank > rank:
            best, rank = candidate, own_rank
    if best is None:
        raise ConfigurationError("Expected at least one camouflage to choose from; give some.")
    return Chosen(best, tuple(hidden), _BATCHES * settings.batch_size)


def _scores(
    camouflage: Camouflage | None,
    detectors: Sequence[LoadedDetector[TrainableDetector]],
    world: AttackWorld,
    batches: Sequence[list[Scene]],
) -> dict[str, Float[Tensor, " scenes"]]:
    """Gives each detector's best score on the one vehicle of every scene."""
    found: dict[str, list[Tensor]] = {each.name: [] for each in detectors}
    bare_on = detectors[0].detector
    for scenes in batches:
        frames = (
            world.bare(scenes, bare_on) if camouflage is None else world.frames(camouflage, scenes)
        )
        for each in detectors:
            found[each.name].append(target_scores(each.detector, frames, world.backgrounds.gsd_m))
    return {name: torch.cat(scores) for name, scores in found.items()}


def _found_bare(
    detectors: Sequence[LoadedDetector[TrainableDetector]],
    world: AttackWorld,
    batches: Sequence[list[Scene]],
) -> dict[str, int]:
    """Counts the vehicles that each detector finds without camouflage."""
    scores = _scores(None, detectors, world, batches)
    found = {each.name: int((scores[each.name] >= each.threshold).sum()) for each in detectors}
    for name, count in found.items():
        if not count:
            raise ConfigurationError(
                f"The detector {name} finds no vehicle of the attack's scenes without camouflage, "
                "so that nothing can be hidden from it; train it longer, or leave it out."
            )
    return found


@torch.no_grad()
def search_step(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    world: AttackWorld,
    settings: AttackSettings,
    step: int,
) -> tuple[dict[str, float], Float[Tensor, "B 3 H W"]]:
    """Tries one random change, and keeps it if the attack's own loss is lower with it.

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
        Every detector's mean loss for the camouflage that is kept, and its images.
    """
    scenes = world.step_scenes(max(1, settings.batch_size // 2), settings.seed, step)
    other = copy.deepcopy(camouflage)
    other.vary_(torch.Generator().manual_seed((settings.seed * 1_000_033 + step) % 2**63))
    totals, found = [], []
    for each in (camouflage, other):
        images = world.frames(each, scenes).image
        by_detector = empty_truth_losses(detectors, images)
        losses = {name: float(loss.mean()) for name, loss in by_detector.items()}
        totals.append(sum(weights[name] * loss for name, loss in losses.items()))
        found.append((losses, images))
    if totals[1] < totals[0]:
        camouflage.load_state_dict(other.state_dict())
        return found[1]
    return found[0]
