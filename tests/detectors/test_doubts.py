"""What a card holds against its detector: near-zero AP, a threshold from a handful of vehicles."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from skyproof.detectors.blueprint import ARCHITECTURES, Blueprint
from skyproof.detectors.card import LEAST_AP, LEAST_VEHICLES, DetectorCard, read_card
from skyproof.detectors.loaded import build_detector, save_detector


@pytest.mark.parametrize(
    ("ap", "vehicles", "words"),
    [
        (0.006, 300, ["validation AP of 0.006"]),
        (0.0, 300, ["validation AP of 0.000"]),
        (LEAST_AP - 1e-9, None, ["train it longer"]),
        (0.95, 5, ["chosen on 5 vehicles"]),
        (None, LEAST_VEHICLES - 1, ["give validation images with more"]),
        (0.006, 5, ["validation AP of 0.006", "chosen on 5 vehicles"]),
        (LEAST_AP, LEAST_VEHICLES, []),
        (None, None, []),
    ],
)
def test_each_doubt_is_one_sentence(
    ap: float | None, vehicles: int | None, words: list[str]
) -> None:
    card = DetectorCard("mine", threshold=0.5, gsd_m=0.125, validation_vehicles=vehicles)
    validation = {} if ap is None else {"ap_centre_1m": ap}
    found = replace(card, size="slim", validation=validation).doubts
    assert len(found) == len(words)
    for sentence, part in zip(found, words, strict=True):
        assert part in sentence
        assert "mine" in sentence
        assert sentence.endswith(".")
        assert ". " not in sentence


def test_a_black_box_detector_is_not_trained_here() -> None:
    card = DetectorCard("theirs", threshold=0.5, gsd_m=0.125, validation={"ap_centre_1m": 0.01})
    assert "check its boxes and the metres per pixel" in card.doubts[0]


def test_an_imported_detector_gets_another_remedy() -> None:
    brought = Blueprint("torchvision", ARCHITECTURES[0], ["0"], [0], 1.0, None, "x.pth", "0")
    card = DetectorCard(
        "theirs", threshold=0.5, gsd_m=0.125, validation={"ap_centre_1m": 0.01}, brought=brought
    )
    (sentence,) = card.doubts
    assert "check that the checkpoint was trained" in sentence
    assert "--vehicle-classes" in sentence


def test_a_threshold_frozen_on_labels_doubts_the_labels() -> None:
    card = DetectorCard("mine", threshold=0.5, gsd_m=0.125, size="slim", threshold_from="labels")
    (sentence,) = replace(card, validation={"ap_centre_1m": 0.01}).doubts
    assert "check the labels and the metres per pixel" in sentence


def test_the_card_keeps_what_the_doubts_come_from(tmp_path: Path) -> None:
    detector = build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(0))
    card = DetectorCard(
        "retinanet",
        size="slim",
        threshold=0.5,
        gsd_m=0.125,
        validation={"ap_centre_1m": 0.006, "ap_iou_50": 0.0, "f1": 0.1},
        validation_vehicles=5,
    )
    save_detector(tmp_path / "stored", detector, card)
    assert read_card(tmp_path / "stored").doubts == card.doubts
    assert len(card.doubts) == 2
    # A card from before the vehicles were counted says nothing of them.
    old = Path(shutil.copytree(tmp_path / "stored", tmp_path / "old"))
    record = json.loads((old / "detector.json").read_text())
    del record["validation_vehicles"]
    (old / "detector.json").write_text(json.dumps(record))
    assert read_card(old).validation_vehicles is None
    assert read_card(old).doubts == card.doubts[:1]
