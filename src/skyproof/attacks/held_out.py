"""Scenes that no step of an attack sees, and how many of their vehicles a camouflage hides."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from skyproof.attacks.objective import target_scores
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.inference import device_of
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.weights import weights_digest
from skyproof.errors import ConfigurationError
from skyproof.scenes.scene import Scene

BATCHES = 8
BATCH_SIZE = 8


class Judged(NamedTuple):
    """How well a camouflage hides; of two of them the greater one hides more.

    Attributes:
        hidden: EASR, mean over the detectors, where found means a candidate at the threshold whose
            centre lies within 1 m. Scores go by detections, which suppress neighbours first.
        silence: minus the mean over scenes and detectors of the best score on the target, which
            decides where as many are hidden.
    """

    hidden: float
    silence: float


class HeldOut:
    """Eight batches of an attack's scenes, one vehicle each, that no step of it sees.

    They are of the attack's own ground and vehicles, so what is measured on them guides an attack;
    it is no result.

    Args:
        detectors: with the thresholds that count, on the device to work on.
        world: what the attack sees.
        seed: of the attack; its scenes are drawn from it.
        batch_size: scenes of a batch. That of the attack may be smaller: what small steps have
            learnt is judged on as many scenes.
    """

    def __init__(
        self,
        detectors: Sequence[LoadedDetector[Detector | TrainableDetector]],
        world: World,
        seed: int,
        batch_size: int = BATCH_SIZE,
    ) -> None:
        self._detectors = detectors
        self._world = world
        self._seed = seed
        self._batch_size = batch_size

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Which detectors judge: by name the digest of their weights, if known, and threshold."""
        return {
            each.name: [
                weights_digest(each.detector) if isinstance(each.detector, nn.Module) else "",
                each.threshold,
            ]
            for each in self._detectors
        }

    def scenes(self, batches: int = BATCHES) -> int:
        """Says how many scenes so many batches hold."""
        return batches * self._batch_size

    @torch.no_grad()
    def judge(self, camouflage: Camouflage, batches: int = BATCHES) -> Judged:
        """Says how much a camouflage hides on the first so many batches.

        Raises:
            ConfigurationError: a detector finds no vehicle of all the scenes without camouflage.
        """
        shown = self._scores(camouflage, batches)
        left = []
        for each in self._detectors:
            before = int(self._bare[each.name][: self.scenes(batches)].sum())
            after = int((shown[each.name] >= each.threshold).sum())
            # Of a few scenes only, a detector may have found none before: nothing is hidden there.
            left.append(after / before if before else 1.0)
        silence = -float(torch.stack(list(shown.values())).mean())
        return Judged(1 - sum(left) / len(left), silence)

    @cached_property
    def _bare(self) -> dict[str, Bool[Tensor, " scenes"]]:
        """Which vehicles each detector finds without camouflage."""
        scores = self._scores(None, BATCHES)
        found = {each.name: scores[each.name] >= each.threshold for each in self._detectors}
        for name, those in found.items():
            if not those.any():
                raise ConfigurationError(
                    f"The detector {name} finds no vehicle of the attack's scenes without "
                    "camouflage, so that nothing can be hidden from it; train it longer, or leave "
                    "it out."
                )
        return found

    @cached_property
    def _batches(self) -> list[list[Scene]]:
        return [
            self._world.step_scenes(self._batch_size, self._seed, -batch)
            for batch in range(BATCHES)
        ]

    def _scores(
        self, camouflage: Camouflage | None, batches: int
    ) -> dict[str, Float[Tensor, " scenes"]]:
        """Gives each detector's best score on the one vehicle of every scene."""
        world = self._world
        scores: dict[str, list[Tensor]] = {each.name: [] for each in self._detectors}
        for scenes in self._batches[:batches]:
            if camouflage is None:
                frames = world.bare(scenes, device_of(self._detectors[0].detector))
            else:
                frames = world.frames(camouflage, scenes)
            for each in self._detectors:
                own = target_scores(each.detector, frames, world.backgrounds.gsd_m)
                scores[each.name].append(own)
        return {name: torch.cat(own) for name, own in scores.items()}
