"""Scenes that no step of an attack sees, and how many of their vehicles a camouflage hides."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.attacks.objective import target_scores
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.inference import device_of
from skyproof.errors import ConfigurationError
from skyproof.ranges import Match
from skyproof.render.dataset import AT_A_TIME, in_threads
from skyproof.scenes.scene import Scene

BATCHES = 8
BATCH_SIZE = 8

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class Hidden(NamedTuple):
    """How well a camouflage hides vehicles; the greater of two hides more.

    `hidden` is the mean EASR over detectors. A vehicle is found if a candidate at the threshold
    matches it; other rates use detections after suppression. `silence` is minus the mean best score
    on the target, which decides between equals.
    """

    hidden: float
    silence: float


@dataclass(eq=False)
class HeldOut:
    """Eight batches of an attack's scenes, one vehicle each, that no step of it sees.

    They share its ground and vehicles, so rates are no result. `batch_size` may exceed its own.
    """

    detectors: Sequence[Detector]
    world: World
    seed: int
    batch_size: int
    match: Match = "centre_1m"

    @cached_property
    def identity(self) -> dict[str, Any]:
        """By detector the digest of its weights, if it has any, and its threshold."""
        return {each.name: [each.weights_sha256, each.threshold] for each in self.detectors}

    def scenes(self, batches: int = BATCHES) -> int:
        """The number of scenes in so many batches."""
        return batches * self.batch_size

    @torch.no_grad()
    def measure(self, camouflage: Camouflage, batches: int = BATCHES) -> Hidden:
        """Measures how much a camouflage hides on the first batches."""
        scores = self._scores(camouflage, batches)
        left = []
        for each in self.detectors:
            before = int(self._found[each.name][: self.scenes(batches)].sum())
            after = int((scores[each.name] >= each.threshold).sum())
            # In few scenes a detector may find nothing before: then nothing is hidden from it.
            left.append(after / before if before else 1.0)
        silence = -float(torch.stack(list(scores.values())).mean())
        return Hidden(1 - sum(left) / len(left), silence)

    @cached_property
    def _found(self) -> dict[str, Bool[Tensor, " scenes"]]:
        """Whether each detector finds each vehicle without camouflage."""
        scores = self._scores(None, BATCHES)
        found = {each.name: scores[each.name] >= each.threshold for each in self.detectors}
        for name, vehicles in found.items():
            if not vehicles.any():
                raise ConfigurationError(
                    f"The detector {name} finds no vehicle in the attack's scenes without "
                    "camouflage, so nothing can be hidden from it; train it longer, or leave it "
                    "out."
                )
        return found

    @cached_property
    def _batches(self) -> list[list[Scene]]:
        steps = range(BATCHES)
        return [self.world.step_scenes(self.batch_size, self.seed, -step) for step in steps]

    def _scores(
        self, camouflage: Camouflage | None, batches: int
    ) -> dict[str, Float[Tensor, " scenes"]]:
        """Each detector's best score on the vehicle of every scene."""
        device = device_of(self.detectors[0])
        gsd_m = self.world.backgrounds.gsd_m

        @torch.no_grad()
        def show(scenes: list[Scene]) -> list[Tensor]:
            frames = self.world.frames(camouflage, scenes, device)
            return [target_scores(each, frames, gsd_m, self.match) for each in self.detectors]

        found = at_a_time(show, self._batches[:batches], self.detectors)
        return {
            each.name: torch.cat([scores[number] for scores in found])
            for number, each in enumerate(self.detectors)
        }


def at_a_time(
    work: Callable[[_Item], _Result], items: Sequence[_Item], detectors: Sequence[Detector]
) -> list[_Result]:
    """Runs work that shows images to detectors; on a CPU, networks see several items at a time.

    Only the caller's thread calls black-box detectors, whose code may not be thread-safe.
    """
    networks = all(isinstance(each, TrainableDetector) for each in detectors)
    if not networks or device_of(detectors[0]).type != "cpu":
        return [work(item) for item in items]
    with in_threads(work, items, min(torch.get_num_threads(), AT_A_TIME)) as results:
        return list(results)
