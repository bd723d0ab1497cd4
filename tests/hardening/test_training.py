"""Hardening: camouflages that climb while a detector learns, and going on after a kill."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.detectors import training
from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.errors import RunFolderError
from skyproof.hardening import training as hardening
from skyproof.hardening.training import harden
from skyproof.scenes.settings import SceneSettings
from tests.rendered_world import RenderedWorld, make_world

SETTINGS = TrainingSettings(steps=20, batch_size=4, learning_rate=1e-3, checkpoint_every=4)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RenderedWorld:
    return make_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    # Camouflages are kept, and kept ones are shown, within a few steps; so are those of rounds.
    monkeypatch.setattr(hardening, "_LIFE_STEPS", 6)
    monkeypatch.setattr(hardening, "_ROUND_STEPS", 8)
    monkeypatch.setattr(hardening, "_ROUND", dataclasses.replace(hardening._ROUND, steps=3))


def world_of(rendered: RenderedWorld) -> World:
    scenes = SceneSettings(size_px=96, vehicles_maximum=1)
    return World(rendered.renderer(), rendered.ground, rendered.fleets["train"], scenes)


def images(rendered: RenderedWorld, split: str) -> Dataset:
    return rendered.images(split, rendered.scenes(split, 4, 1, 2))


def run(
    rendered: RenderedWorld,
    folder: Path,
    photographs: Dataset | None = None,
    settings: TrainingSettings = SETTINGS,
    **more: Any,
) -> tuple[TrainableDetector, DetectorCard]:
    detector = load_detector("retinanet")
    validation = images(rendered, "validation")
    card = harden(
        detector, world_of(rendered), photographs, validation, settings, folder, seed=3, **more
    )
    return detector, card


def test_a_stopped_hardening_goes_on_exactly(rendered: RenderedWorld, tmp_path: Path) -> None:
    whole, _ = run(rendered, tmp_path / "whole", images(rendered, "train"))

    def kill(row: dict[str, Any]) -> None:
        if row["step"] == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(rendered, tmp_path / "killed", images(rendered, "train"), on_step=kill)
    resumed, _ = run(rendered, tmp_path / "killed", images(rendered, "train"))
    assert resumed.weights_sha256 == whole.weights_sha256
    assert load_detector(tmp_path / "killed").weights_sha256 == whole.weights_sha256
    # Nothing is done again, and other settings are refused.
    run(rendered, tmp_path / "killed", images(rendered, "train"))
    with pytest.raises(RunFolderError, match="another seed, start or images"):
        run(rendered, tmp_path / "killed")


def test_the_card_names_the_parent_and_statistics_stay(
    rendered: RenderedWorld, tmp_path: Path
) -> None:
    parent = load_detector("retinanet")
    detector, card = run(rendered, tmp_path / "out")
    assert card.training["identity"]["parent_sha256"] == parent.weights_sha256
    assert card.validation_vehicles == sum(map(len, images(rendered, "validation").boxes))
    assert detector.weights_sha256 != parent.weights_sha256
    stored, before = detector.state_dict(), parent.state_dict()
    statistics = [name for name in stored if name.endswith(("running_mean", "running_var"))]
    assert statistics
    assert all(torch.equal(stored[name], before[name]) for name in statistics)


@pytest.mark.parametrize(
    ("aps", "share"),
    [
        ([0.9, 0.891], 1.0),
        ([0.9, 0.5, 0.895], 0.75),
        ([0.9, 0.5, 0.889, 0.91], 0.5),
        ([0.9, 0.5, 0.6, 0.7, 0.8], 0.25),
    ],
)
def test_as_much_of_the_trained_weights_stays_as_costs_a_point_of_ap_or_a_quarter(
    rendered: RenderedWorld,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    aps: list[float],
    share: float,
) -> None:
    settings = dataclasses.replace(SETTINGS, steps=2)
    trained, card = run(rendered, tmp_path / "trained", settings=settings, shares=[1.0])
    assert card.training["trained_share"] == 1.0
    usual, left = training.validate, iter(aps)
    monkeypatch.setattr(
        training, "validate", lambda *given: {**usual(*given), "ap_centre_1m": next(left)}
    )
    mixed, card = run(rendered, tmp_path / "mixed", settings=settings)
    assert next(left, None) is None
    assert card.training["trained_share"] == share
    assert card.training["ap_lost"] == pytest.approx(aps[0] - aps[-1])
    assert card.validation["ap_centre_1m"] == aps[-1]
    every = zip(
        load_detector("retinanet").named_parameters(),
        mixed.parameters(),
        trained.parameters(),
        strict=True,
    )
    for (name, parent), part, whole in every:
        torch.testing.assert_close(part, parent + share * (whole - parent), msg=name)
    assert (mixed.weights_sha256 == trained.weights_sha256) == (share == 1.0)


def test_photographs_are_a_quarter_of_the_images(
    rendered: RenderedWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[list[int]] = []
    usual = hardening.add_gradients

    def remember(detector: TrainableDetector, batches: Any) -> Any:
        assert all(len(images) == len(boxes) for images, boxes in batches)
        shown.append([len(images) for images, _ in batches])
        return usual(detector, batches)

    monkeypatch.setattr(hardening, "add_gradients", remember)
    settings = dataclasses.replace(SETTINGS, steps=1)
    run(rendered, tmp_path / "photographs", images(rendered, "train"), settings)
    run(rendered, tmp_path / "none", None, settings)
    assert shown == [[2, 1, 1], [2, 2]]


def test_camouflages_climb_the_loss_that_the_detector_descends(
    rendered: RenderedWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Camouflage] = []
    make = hardening.make_camouflage

    def remember(*given: Any, **more: Any) -> Camouflage:
        made.append(make(*given, **more))
        return made[-1]

    monkeypatch.setattr(hardening, "make_camouflage", remember)
    constants = {"_LIFE_STEPS": 80, "_ALIVE": 1, "ATTACKS": ("T-U",), "_ROUND_STEPS": 80}
    for name, value in constants.items():
        monkeypatch.setattr(hardening, name, value)
    # The detector hardly moves, so only the camouflage does.
    still = dataclasses.replace(SETTINGS, steps=60, learning_rate=1e-9, checkpoint_every=60)
    detector, _ = run(rendered, tmp_path / "out", settings=still)
    (climber,) = made
    ((_, start, _),) = hardening._Worn(3, torch.rand(5, 3), torch.device("cpu"))._alive
    assert loss_of(rendered, detector, climber) > loss_of(rendered, detector, start) + 0.3


def test_rounds_attack_the_averaged_weights_and_keep_the_textures(
    rendered: RenderedWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[hardening._Worn] = []
    attacked: list[TrainableDetector] = []
    weights: list[torch.Tensor] = []  # before each step
    usual = hardening.add_gradients

    def of(detector: TrainableDetector) -> torch.Tensor:
        return next(detector.parameters()).detach().clone()

    def remember(detector: TrainableDetector, batches: Any) -> Any:
        weights.append(of(detector))
        return usual(detector, batches)

    class Remembered(hardening._Worn):
        def attack(self, detector: TrainableDetector, world: World, step: int) -> None:
            super().attack(detector, world, step)
            made.append(self)
            attacked.append(copy.deepcopy(detector))

    monkeypatch.setattr(hardening, "_Worn", Remembered)
    monkeypatch.setattr(hardening, "add_gradients", remember)
    monkeypatch.setattr(hardening, "_LIFE_STEPS", 80)
    monkeypatch.setattr(hardening, "_ROUND", dataclasses.replace(hardening._ROUND, steps=40))
    run(rendered, tmp_path / "out", settings=dataclasses.replace(SETTINGS, steps=9))
    (worn,), (detector,) = made, attacked
    average = weights[0]
    for count, now in enumerate(weights[1:], 1):
        average = average.lerp(now, 1 - count / (count + 10))
    assert len(weights) == 9
    torch.testing.assert_close(of(detector), average)
    assert [str(kept.name) for _, kept in worn._kept] == ["T-U", "T-Ma"]
    for number, kept in worn._kept:
        _, start, _ = worn._fresh(number)
        assert loss_of(rendered, detector, kept) > loss_of(rendered, detector, start) + 0.3


@torch.no_grad()
def loss_of(rendered: RenderedWorld, detector: TrainableDetector, worn: Camouflage) -> float:
    """The loss of a detector on vehicles in a camouflage."""
    world = world_of(rendered)
    scenes = world.step_scenes(24, 1, 1)
    frames = world.frames(worn, scenes)
    boxes = [frames.boxes[frames.scene_index == row] for row in range(len(scenes))]
    return float(detector.loss(frames.image, boxes).mean())


def test_an_imported_detector_is_hardened_and_stays_imported(
    rendered: RenderedWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hardening, "_ROUND_STEPS", 1)
    architecture = "fasterrcnn_mobilenet_v3_large_fpn"
    plan = Blueprint("torchvision", architecture, ["0", "1", "2"], [1, 2], 1.0, None, "x.pth", "0")
    torch.manual_seed(0)
    detector = ImportedDetector("mine", plan).eval()
    own = {"threshold": 0.5, "gsd_m": 0.125, "size": "brought", "brought": plan}
    detector.set_card(DetectorCard(name="mine", **own, trained_on="x.pth"))
    before = detector.weights_sha256
    settings = dataclasses.replace(SETTINGS, steps=2)
    validation = images(rendered, "validation")
    world = world_of(rendered)
    card = harden(detector, world, None, validation, settings, tmp_path / "out", seed=3)
    stored = load_detector(tmp_path / "out")
    assert isinstance(stored, ImportedDetector)
    assert stored.weights_sha256 == detector.weights_sha256 != before
    assert (card.brought, card.trained_on) == (plan, "x.pth; hardened")
    assert card.training["identity"]["parent_sha256"] == before
