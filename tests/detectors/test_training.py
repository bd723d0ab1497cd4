"""Training: augmentation that moves boxes rightly, learning, and going on after a kill."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from detector_images import bar_images

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.batches import jitter, turn
from skyproof.detectors.loaded import build_detector, load_detector
from skyproof.detectors.settings import DETECTOR_NAMES, SIZES, TRAINING_PRESETS, TrainingSettings
from skyproof.detectors.training import train
from skyproof.errors import (
    ConfigurationError,
    NotFiniteError,
    RunFolderError,
    StoredFileError,
)
from skyproof.files import alone
from skyproof.storage import read_tensors, weights_digest

SETTINGS = TrainingSettings(
    steps=6, batch_size=2, learning_rate=1e-3, validate_every=3, checkpoint_every=2
)
TRAINING, VALIDATION = bar_images(7, seed=2), bar_images(3, seed=3)


def run(
    folder: Path, settings: TrainingSettings = SETTINGS, on_step: Any = None, seed: int = 0
) -> Any:
    generator = torch.Generator().manual_seed(seed)
    detector = build_detector("retinanet", "slim", generator=generator)
    card = train(
        detector, TRAINING, VALIDATION, settings, folder, generator=generator, on_step=on_step
    )
    return detector, card


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_boxes_follow_the_mask_through_every_turn(quarter_turns: int, mirror: bool) -> None:
    boxes = torch.tensor([[3.0, 5, 12, 9], [20, 1, 25, 14]])
    image = torch.zeros(3, 17, 31)
    for channel, (left, top, right, bottom) in enumerate(boxes.int().tolist()):
        image[channel, top:bottom, left:right] = 1
    turned, moved = turn(image, boxes, quarter_turns=quarter_turns, mirror=mirror)
    for channel, box in enumerate(moved.tolist()):
        rows, columns = turned[channel].nonzero(as_tuple=True)
        mask_box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert box == [float(value) for value in mask_box]


def test_jitter_stays_in_range_is_mild_and_repeatable() -> None:
    images = torch.rand(8, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    first = jitter(images, 1.0, generator=torch.Generator().manual_seed(1))
    assert first.min() >= 0
    assert first.max() <= 1
    assert 0.01 < (first - images).abs().mean() < 0.25
    assert torch.equal(first, jitter(images, 1.0, generator=torch.Generator().manual_seed(1)))
    assert torch.equal(images, jitter(images, 0.0, generator=torch.Generator().manual_seed(1)))


def test_jitter_blurs_a_quarter_of_the_images_by_different_amounts() -> None:
    # A chequerboard keeps this much of its contrast behind a blur of 0.3 px and of 1.3 px.
    board = (torch.arange(32)[:, None] + torch.arange(32)) % 2
    images = (0.4 + 0.2 * board).expand(400, 3, 32, 32)
    changed = jitter(images, 1.0, generator=torch.Generator().manual_seed(0)).mean(1)
    # Noise averages out over the board, light and contrast hardly change it.
    contrast = (changed * (2 * board - 1)).mean((1, 2)) / 0.1
    blurred = contrast < 0.55
    assert 0.15 < float(blurred.float().mean()) < 0.27
    assert float((contrast < 0.05).float().mean()) > 0.1
    assert float(((contrast > 0.05) & blurred).float().mean()) > 0.03


def test_a_killed_training_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    straight, card = run(tmp_path / "straight")

    def kill(row: dict[str, Any]) -> None:
        if row["kind"] == "step" and row["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", on_step=kill)
    assert not (tmp_path / "killed" / "detector.json").exists()
    seen: list[int] = []
    resumed, resumed_card = run(tmp_path / "killed", on_step=lambda row: seen.append(row["step"]))
    # Killed after step 5, stored at step 4: steps 5 and 6 are done again, then step 6's validation.
    assert seen == [5, 6, 6]
    assert weights_digest(resumed) == weights_digest(straight)
    assert resumed_card == card
    assert card.validation_vehicles == sum(map(len, VALIDATION.boxes))
    assert card.training["data_sha256"] == TRAINING.digest != VALIDATION.digest

    def rows(name: str) -> list[dict[str, Any]]:
        lines = (tmp_path / name / "steps.jsonl").read_text().splitlines()
        return [
            {key: value for key, value in json.loads(line).items() if key != "seconds"}
            for line in lines
        ]

    assert rows("killed") == rows("straight")
    assert [row["step"] for row in rows("straight") if row["kind"] == "validation"] == [3, 6]


def test_a_finished_folder_is_loaded_and_not_trained_again(tmp_path: Path) -> None:
    first, card = run(tmp_path / "run")
    seen: list[dict[str, Any]] = []
    second, again = run(tmp_path / "run", on_step=seen.append)
    assert not seen
    assert again == card
    assert (
        weights_digest(second)
        == weights_digest(first)
        == weights_digest(load_detector(tmp_path / "run"))
    )
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "detector.json",
        "steps.jsonl",
        "weights.safetensors",
    ]
    for settings, seed in ((replace(SETTINGS, steps=7), 0), (SETTINGS, 1)):
        with pytest.raises(RunFolderError, match="other settings"):
            run(tmp_path / "run", settings, seed=seed)


def test_other_images_of_the_same_settings_are_refused(tmp_path: Path) -> None:
    def train_on(training: Dataset, validation: Dataset, on_step: Any = None) -> None:
        generator = torch.Generator().manual_seed(0)
        detector = build_detector("retinanet", "slim", generator=generator)
        train(
            detector,
            training,
            validation,
            replace(SETTINGS, steps=1),
            tmp_path,
            generator=generator,
            on_step=on_step,
        )

    def kill(row: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    def refused() -> None:
        for images in ((VALIDATION, VALIDATION), (TRAINING, TRAINING)):
            with pytest.raises(RunFolderError, match="start or images"):
                train_on(*images)

    with pytest.raises(KeyboardInterrupt):
        train_on(TRAINING, VALIDATION, kill)
    refused()
    train_on(TRAINING, VALIDATION)
    refused()


def test_damaged_checkpoint_and_other_settings_are_refused(tmp_path: Path) -> None:
    def kill(row: dict[str, Any]) -> None:
        if row["step"] == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, on_step=kill)
    with pytest.raises(RunFolderError, match="other settings"):
        run(tmp_path, replace(SETTINGS, learning_rate=2e-3))
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(StoredFileError, match="damaged"):
        run(tmp_path)


def test_ignored_vehicles_are_hidden_and_mixed_sizes_and_empty_images_allowed(
    tmp_path: Path,
) -> None:
    small, large = bar_images(4, seed=4), bar_images(3, 128, seed=5)
    region = torch.tensor([[0.0, 0, 50, 50]])
    mixed = replace(Dataset.joined([small, large]), ignore=[region] * 7)
    generator = torch.Generator().manual_seed(0)
    detector = build_detector("faster_rcnn", "slim", generator=generator)
    card = train(detector, mixed, mixed, replace(SETTINGS, steps=2), tmp_path, generator=generator)
    assert card.image_size_px == (96, 96)


def test_useless_data_and_settings_are_refused(tmp_path: Path) -> None:
    empty = bar_images(1, seed=0)
    for training, validation in (
        (empty, VALIDATION),
        (TRAINING, empty),
        (TRAINING, replace(VALIDATION, gsd_m=0.25)),
    ):
        generator = torch.Generator().manual_seed(0)
        detector = build_detector("retinanet", "slim", generator=generator)
        with pytest.raises(ConfigurationError):
            train(detector, training, validation, SETTINGS, tmp_path, generator=generator)
    for name in ("steps", "batch_size", "validate_every", "checkpoint_every"):
        with pytest.raises(ConfigurationError):
            replace(SETTINGS, **{name: 0})
    with pytest.raises(ConfigurationError):
        replace(SETTINGS, learning_rate=0.0)


def test_every_detector_has_a_preset() -> None:
    assert set(TRAINING_PRESETS) == {(name, size) for name in DETECTOR_NAMES for size in SIZES}


def test_a_training_that_diverges_stops_with_a_sentence_and_keeps_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(0))
    usual = detector.loss
    calls = []

    def diverging(images: torch.Tensor, targets: list[torch.Tensor]) -> torch.Tensor:
        calls.append(1)
        loss = usual(images, targets)
        return loss * float("nan") if len(calls) == 5 else loss

    monkeypatch.setattr(detector, "loss", diverging)
    settings = replace(SETTINGS, checkpoint_every=2)
    with pytest.raises(NotFiniteError, match=r"is nan .* at step 5; .*lower learning rate"):
        train(
            detector,
            TRAINING,
            VALIDATION,
            settings,
            tmp_path,
            generator=torch.Generator().manual_seed(0),
        )
    tensors, record = read_tensors(tmp_path / "checkpoint.safetensors", "")
    assert record["step"] == 4
    assert not (tmp_path / "detector.json").exists()
    assert all(value.isfinite().all() for value in tensors.values())


def test_weights_that_are_not_finite_are_not_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mean or deviation may break in a layer that training itself does not read."""
    detector = build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(0))
    usual = detector.loss

    def breaking(images: torch.Tensor, targets: list[torch.Tensor]) -> torch.Tensor:
        next(
            value for name, value in detector.named_buffers() if name.endswith("running_var")
        ).fill_(float("inf"))
        return usual(images, targets)

    monkeypatch.setattr(detector, "loss", breaking)
    with pytest.raises(NotFiniteError, match=r"What step \d+ left .* begin again"):
        train(
            detector,
            TRAINING,
            VALIDATION,
            replace(SETTINGS, checkpoint_every=2),
            tmp_path,
            generator=torch.Generator().manual_seed(0),
        )
    assert not (tmp_path / "detector.json").exists()


@pytest.mark.parametrize(
    "changed",
    [
        {"steps": 0},
        {"steps": 10**9},
        {"learning_rate": math.inf},
        {"learning_rate": 1e300},
        {"weight_decay": -1.0},
        {"warm_up": 1.5},
        {"largest_gradient_norm": 0.0},
        {"average_decay": 1.0},
        {"jitter": math.nan},
    ],
    ids=str,
)
def test_settings_out_of_range_are_refused(changed: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match=f"^{next(iter(changed))} expects"):
        replace(SETTINGS, **changed)  # type: ignore[arg-type]


def test_two_trainings_do_not_share_a_folder(tmp_path: Path) -> None:
    detector = build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(0))
    with alone(tmp_path), pytest.raises(RunFolderError, match="being written by another process"):
        train(
            detector,
            TRAINING,
            VALIDATION,
            SETTINGS,
            tmp_path,
            generator=torch.Generator().manual_seed(0),
        )
    assert not list(tmp_path.iterdir())
