"""A tiny reproduction on two trainings of a detector that hardly learnt anything."""

import csv
import json
from pathlib import Path

import pytest

from skyproof.detectors.card import read_card
from skyproof.reproduction.command import Reproduce
from skyproof.reproduction.layout import PaperLayout
from tests.barely_trained import everything_counts

TINY = json.loads(Path(__file__).with_name("tiny.json").read_text())


@pytest.mark.slow
def test_two_trainings(tmp_path):
    preset = tmp_path / "preset.json"
    steps = {"texture": 1, "shape": 1, "sequential": 1, "parallel": 1}
    less = {
        "attack_steps": steps,
        "magnitudes": [],
        "textures": ["U", "Pix", "Fc"],
    }
    preset.write_text(json.dumps({**TINY, **less, "trainings": 2}))
    folder = tmp_path / "run"
    with everything_counts():
        Reproduce(str(preset), folder, cores=1).run()
    layout = PaperLayout(folder)
    further = layout.training(1)
    cards = [read_card(place.detector("retinanet")) for place in (layout, further)]
    facts = ("images", "data_sha256", "validation_sha256")
    assert [cards[0].training[name] for name in facts] == [
        cards[1].training[name] for name in facts
    ]
    assert len(cards[0].training["data_sha256"]) == 64
    assert cards[0].training["identity"]["seed"] != cards[1].training["identity"]["seed"]
    # World and draws are the run's; the training's folder holds what is its own.
    assert {path.name for path in further.folder.iterdir()} == {
        "camouflages",
        "detectors",
        "scores",
    }
    assert {path.name for path in further.camouflages.iterdir()} == {"T-U-0", "T-Pix-0", "T-Fc-0"}
    with open(layout.tables / "trainings.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["attack"] for row in rows] == ["T-U", "T-Pix", "T-Fc"]
    # Two trainings are charged with the usual spread at least.
    assert all(float(row["easr_high"]) - float(row["easr_low"]) >= 4 for row in rows)
