"""Training on vehicles in camouflages that are optimised against the detector as it learns."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks.attack import attack, make_optimiser
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World, boxes_in_sight
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import made_ahead
from skyproof.detectors.batches import jitter, training_batches
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.inference import device_of
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import add_gradients, fit
from skyproof.randomness import generator_of
from skyproof.seeds import next_seed

# T-PixFcMa, shapes and combinations are left out, so that they show whether hardening carries over.
ATTACKS = ("T-U", "T-Ma", "T-Pix")
_ALIVE, _LIFE_STEPS = 4, 80
# After so many steps, the averaged weights are attacked from nothing, as an assessment does.
_ROUND_STEPS, _ROUND_ATTACKS = 250, ATTACKS[:2]
_ROUND = AttackSettings(
    steps=150, batch_size=4, learning_rate=0.05, balance_batches=2, checkpoint_every=150
)
# Camouflages that are kept, and the share of steps that show one, so that none is forgotten.
_KEPT, _KEPT_SHARE = 12, 0.3
_CLIMB = AttackSettings(learning_rate=0.1)
# The more of the trained weights, the more robust, and the lower the AP (docs/detectors.md). AP on
# renders hardly tells what is lost on photographs, so without labels half is the most.
SHARES, SHARES_WITHOUT_LABELS = (1.0, 0.75, 0.5, 0.25), (0.5, 0.25)
EMPTY_SHARE = 0.5
"""Share of the plain images without vehicles."""


def harden(
    detector: TrainableDetector,
    world: World,
    photographs: Dataset | None,
    validation: Dataset,
    settings: TrainingSettings,
    folder: Path,
    *,
    seed: int,
    shares: Sequence[float] = SHARES,
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> DetectorCard:
    """Trains a detector further, in place and into `folder`, and freezes a new threshold.

    Half of a step's images show vehicles in one of four universal camouflages, a quarter vehicles
    in the paints of the fleet or none, and a quarter labelled photographs, if there are any. One
    backward pass gives the gradients of the network, which go down, and those of the camouflage,
    which go up ("free" adversarial training, Shafahi et al. 2019). A camouflage is optimised for 80
    steps of its own. Then a fresh one follows it, and the old one returns from time to time. Every
    250 steps, T-U and T-Ma are also optimised against the averaged weights, as in an assessment,
    and return likewise. They are stronger than camouflages of 80 steps.

    The result mixes the parent's weights with the averaged ones of the last step: the largest share
    of these that costs at most 1 point of AP on the validation images, else the smallest. Scores on
    images without camouflage choose no step, because they say nothing about robustness. A stopped
    hardening continues, and raises errors, as `train` does.

    Args:
        detector: a detector with its card, on the device to work on.
        world: ground, and vehicles in many paints, apart from those of any test.
        photographs: labelled images, apart from those of any test.
        validation: labelled images to freeze the threshold on.
        settings: steps, images per step and learning rate.
        shares: shares of the trained weights to try, the largest first; the last at any cost.
        folder: detector folder to write.
    """
    parent = detector.card
    device = device_of(detector)
    settings = replace(settings, validate_every=settings.steps)
    identity = {
        "seed": seed,
        "settings": asdict(settings),
        "attacks": list(ATTACKS),
        "rounds": [_ROUND_STEPS, list(_ROUND_ATTACKS), asdict(_ROUND)],
        "parent_sha256": detector.weights_sha256,
        "world_sha256": world.digest,
        "data_sha256": None if photographs is None else photographs.digest,
        "validation_sha256": validation.digest,
        "shares": list(shares),
    }
    # Half of a step's images show camouflages.
    halved = replace(settings, batch_size=settings.batch_size - settings.batch_size // 2)
    camouflaged, plain = world.for_training(), world.for_training(EMPTY_SHARE)
    worn = _Worn(seed, ground_palette(world.backgrounds), device)

    def take_steps(steps: range, averaged: TrainableDetector) -> Iterator[Tensor]:
        make = partial(training_batches, photographs, plain, halved, seed % 2**62, device)
        for step, batches in zip(steps, made_ahead(make, steps), strict=True):
            if step and step % _ROUND_STEPS == 0:
                worn.attack(averaged, world, step)
            draw = generator_of(seed, "attacked", step)
            scenes = camouflaged.draw(settings.batch_size // 2, generator=draw)
            camouflage, climber = worn.of_step(step, draw)
            with torch.set_grad_enabled(climber is not None):
                frames = world.frames(camouflage, scenes)
            shown = frames.image.detach().requires_grad_()
            attacked = (jitter(shown, settings.jitter, generator=draw), boxes_in_sight(frames))
            loss = add_gradients(detector, [attacked, *batches])
            if climber is not None and shown.grad is not None:
                frames.image.backward(-shown.grad)
                climber.step()
                climber.zero_grad(set_to_none=True)
                camouflage.project_()
            yield loss

    card = replace(
        parent,
        training={"identity": identity, "parent": parent.training},
        trained_on="; ".join(filter(None, [parent.trained_on, "hardened"]))[:10_000],
        threshold_from="",
    )
    # A few small images would spoil the batch norms' statistics, and in training mode YOLO's head
    # without suppression passes no gradient to the backbone.
    detector.eval().requires_grad_(True)
    return fit(
        detector,
        validation,
        settings,
        folder,
        identity,
        take_steps,
        card,
        on_step,
        {"worn": worn},
        shares=shares,
    )


class _Worn:
    """The camouflages of a hardening: those being optimised, and earlier ones."""

    def __init__(self, seed: int, palette: Float[Tensor, "K 3"], device: torch.device) -> None:
        self._seed, self._palette, self._device = seed, palette, device
        self._alive = [self._fresh(number) for number in range(_ALIVE)]
        self._kept: list[tuple[int, Camouflage]] = []

    def of_step(
        self, step: int, generator: torch.Generator
    ) -> tuple[Camouflage, torch.optim.Adam | None]:
        """The camouflage of a step, counted from 0, and its optimiser if it is optimised."""
        turn, place = divmod(step, _ALIVE)
        number = _ALIVE * ((turn + place * _LIFE_STEPS // _ALIVE) // _LIFE_STEPS) + place
        before, camouflage, optimiser = self._alive[place]
        if number != before:
            self._keep(before, camouflage)
            self._alive[place] = self._fresh(number)
            _, camouflage, optimiser = self._alive[place]
        if self._kept and float(torch.rand((), generator=generator)) < _KEPT_SHARE:
            chosen = int(torch.randint(len(self._kept), (), generator=generator))
            return self._kept[chosen][1], None
        return camouflage, optimiser

    def attack(self, detector: TrainableDetector, world: World, step: int) -> None:
        """Optimises T-U and T-Ma against a detector, and keeps them."""
        for family in range(len(_ROUND_ATTACKS)):
            number = family - len(ATTACKS) * step  # below zero, apart from the others
            _, camouflage, _ = self._fresh(number)
            settings = replace(_ROUND, seed=next_seed(self._seed, number))
            # After a stop the round starts anew: stored steps fit only weights equal bit for bit.
            with TemporaryDirectory() as folder:
                attack(camouflage, [detector], world, settings, folder)
            self._keep(number, camouflage)

    def _keep(self, number: int, camouflage: Camouflage) -> None:
        kept = copy.deepcopy(camouflage).requires_grad_(False)
        self._kept = [*self._kept, (number, kept)][-_KEPT:]

    def state_dict(self) -> dict[str, Any]:
        """See `LoopPart`."""
        return {
            "alive": {
                str(place): {"number": number, "worn": worn.state_dict(), "by": by.state_dict()}
                for place, (number, worn, by) in enumerate(self._alive)
            },
            "kept": {
                str(place): {"number": number, "worn": worn.state_dict()}
                for place, (number, worn) in enumerate(self._kept)
            },
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `LoopPart`."""
        for place, stored in state_dict["alive"].items():
            number, camouflage, optimiser = self._fresh(stored["number"])
            camouflage.load_state_dict(stored["worn"])
            optimiser.load_state_dict(stored["by"])
            self._alive[int(place)] = (number, camouflage, optimiser)
        self._kept = []
        for place in sorted(state_dict["kept"], key=int):
            stored = state_dict["kept"][place]
            number, camouflage, _ = self._fresh(stored["number"])
            camouflage.load_state_dict(stored["worn"])
            self._kept.append((number, camouflage.requires_grad_(False)))

    def _fresh(self, number: int) -> tuple[int, Camouflage, torch.optim.Adam]:
        name = CamouflageName.parse(ATTACKS[number % len(ATTACKS)])
        camouflage = make_camouflage(
            name,
            generator=generator_of(self._seed, "worn", number),
            palette=self._palette if name.takes_palette else None,
        ).to(self._device)
        return number, camouflage, make_optimiser(camouflage, _CLIMB)
