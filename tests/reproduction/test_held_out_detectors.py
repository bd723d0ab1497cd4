"""Held-out detectors of a reproduction: which may be, where they lie, and what they add."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from skyproof.assessment.run import Step
from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.card import DetectorCard, write_card
from skyproof.errors import ConfigurationError, RunFolderError, StoredFileError
from skyproof.reproduction.held_out_detectors import (
    HeldOutDetector,
    new_tables,
    read_held_out,
    store_detectors,
    stored_tables,
)
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.plan import plan_of_run, reproduction_plan
from skyproof.reproduction.preset import Preset
from tests.reproduction.test_plan import BLENDER, TINY, TINY_FILE, dry_run, leave

PHOTOGRAPHS = {"images": 60, "data_sha256": "a" * 64}
OTHERS = {"images": 60, "data_sha256": "b" * 64}
CARD = DetectorCard(
    "retinanet", threshold=0.4, gsd_m=0.125, training=PHOTOGRAPHS, trained_on="train: photographs"
)
PRESET = Preset.parse(TINY)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan of a config is read in its run folder, which the current folder is not."""
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")


def detector(place: Path, card: DetectorCard = CARD, *, digest: str = "1") -> Path:
    """Leaves a detector folder that can be read and not loaded."""
    place.mkdir(parents=True)
    (place / "weights.safetensors").write_text(f"weights {digest}")
    (place / "steps.jsonl").write_text("{}")
    write_card(place / "detector.json", replace(card, weights_sha256=digest))
    return place


def faster(card: DetectorCard = CARD) -> DetectorCard:
    return replace(card, name="faster_rcnn")


def names(tables: dict[str, list[HeldOutDetector]]) -> dict[str, list[str]]:
    return {table: [detector.card.name for detector in its] for table, its in tables.items()}


def test_tables_hold_what_learnt_from_the_same_images(tmp_path: Path) -> None:
    first = detector(tmp_path / "first")
    second = detector(tmp_path / "a=b" / "second", faster(), digest="2")
    assert names(read_held_out([str(first), str(second)])) == {
        "judges": ["retinanet", "faster_rcnn"]
    }
    apart = read_held_out([f"one={first}", f"other={second}"])
    assert names(apart) == {"one": ["retinanet"], "other": ["faster_rcnn"]}


def test_trainings_of_different_images_in_one_table_are_refused(tmp_path: Path) -> None:
    first = detector(tmp_path / "first")
    card = faster(replace(CARD, training=OTHERS, trained_on="train: other photographs"))
    second = detector(tmp_path / "second", card, digest="2")
    with pytest.raises(ConfigurationError, match="have different training images") as refusal:
        read_held_out([f"real={first}", f"real={second}"])
    said = str(refusal.value)
    assert all(word in said for word in (str(first), str(second), "OTHER=", "train: photographs"))
    # Side by side they may stand, and no mean goes over both.
    assert len(read_held_out([f"real={first}", f"more={second}"])) == 2


def test_cards_without_a_digest_of_the_images_are_told_apart_by_words(tmp_path: Path) -> None:
    old = {"images": 60}
    first = detector(tmp_path / "first", replace(CARD, training=old))
    same = detector(tmp_path / "same", faster(), digest="2")
    more = detector(tmp_path / "more", faster(replace(CARD, training={"images": 61})))
    assert len(read_held_out([str(first), str(same)])["judges"]) == 2
    with pytest.raises(ConfigurationError, match="different training images"):
        read_held_out([str(first), str(more)])


def test_imported_detectors_stand_together_and_not_with_ours(tmp_path: Path) -> None:
    fcos = ("torchvision", "fcos_resnet50_fpn", ["0", "1"], [1])
    brought = Blueprint(*fcos, 1.0, None, "theirs.pth", "c" * 64)
    cards = [
        replace(CARD, name=name, training={}, trained_on=f"elsewhere: {name}.pth", brought=brought)
        for name in ("theirs", "another")
    ]
    folders = [str(detector(tmp_path / card.name, card)) for card in cards]
    assert len(read_held_out(folders)["judges"]) == 2
    with pytest.raises(ConfigurationError, match="different training images"):
        read_held_out([*folders, str(detector(tmp_path / "ours"))])


@pytest.mark.parametrize("table", ["a b=", "=", "{x}=", "-=", "x" * 41 + "=", "..="])
def test_tables_have_plain_names(tmp_path: Path, table: str) -> None:
    with pytest.raises(ConfigurationError, match="TABLE="):
        read_held_out([f"{table}{detector(tmp_path / 'first')}"])


def test_other_detectors_are_refused(tmp_path: Path) -> None:
    first = detector(tmp_path / "first")
    with pytest.raises(ConfigurationError, match="second retinanet of the table judges"):
        read_held_out([str(first), str(detector(tmp_path / "second", digest="2"))])
    coarse = detector(tmp_path / "coarse", replace(CARD, gsd_m=0.3))
    with pytest.raises(ConfigurationError, match=r"0\.3 m per pixel"):
        read_held_out([str(coarse)])
    with pytest.raises(StoredFileError, match=r"detector\.json"):
        read_held_out([str(tmp_path)])


def test_they_are_kept_in_the_run_folder_and_stay_as_they_are(tmp_path: Path) -> None:
    layout = PaperLayout(tmp_path / "run")
    first = detector(tmp_path / "first")
    given = read_held_out([f"real={first}"])
    store_detectors(layout, PRESET, new_tables(layout, PRESET, given))
    assert stored_tables(layout) == {"real": ("retinanet",)}
    copied = layout.table("real").detector("retinanet")
    # Neither the log of the training nor anything of another's folder is needed.
    assert {path.name for path in copied.iterdir()} == {"weights.safetensors", "detector.json"}
    # The same again is nothing new, whichever folder it comes from.
    assert new_tables(layout, PRESET, given) == {}
    moved = detector(tmp_path / "moved")
    assert new_tables(layout, PRESET, read_held_out([f"real={moved}"])) == {}
    # Others under that name are refused, and may come beside.
    other = detector(tmp_path / "other", digest="2")
    with pytest.raises(RunFolderError, match="table real of other detectors"):
        new_tables(layout, PRESET, read_held_out([f"real={other}"]))
    frozen = detector(tmp_path / "frozen", replace(CARD, threshold=0.5))
    with pytest.raises(RunFolderError, match="table real of other detectors"):
        new_tables(layout, PRESET, read_held_out([f"real={frozen}"]))
    assert list(new_tables(layout, PRESET, read_held_out([f"more={other}"]))) == ["more"]
    # What a kill left is no table.
    (layout.held_out / ".half.partial").mkdir()
    assert stored_tables(layout) == {"real": ("retinanet",)}


def test_a_detector_that_is_attacked_is_not_held_out(tmp_path: Path) -> None:
    layout = PaperLayout(tmp_path / "run")
    attacked = detector(layout.detector("retinanet"))
    with pytest.raises(ConfigurationError, match="RetinaNet that this run attacks"):
        new_tables(layout, PRESET, read_held_out([str(attacked)]))


def steps_of(cycles: bool) -> dict[str, Step]:
    held_out = {"more": ("yolov5",), "real": ("faster_rcnn", "retinanet")}
    plan = reproduction_plan(
        PRESET, Path("run"), blender=BLENDER if cycles else None, held_out=held_out
    )
    return {step.id: step for step in plan.steps}


def test_they_score_what_the_run_renders() -> None:
    steps = steps_of(cycles=True)
    added = [name for name in steps if "judges" in name]
    tables = ("more", "real")
    batches = ("000", "001", "cycles-000", "cycles-001")
    assert added == [f"score/judges.{table}.{batch}" for table in tables for batch in batches]
    score = steps["score/judges.real.001"]
    places = [Path("run/judges/real/detectors") / name for name in ("faster_rcnn", "retinanet")]
    assert list(score.settings.detectors) == places  # type: ignore[attr-defined]
    assert score.outputs == (Path("run/judges/real/scores/001"),)
    # Attacks as they are finished: neither copies kept on the way nor colours before rounding.
    worn = [folder.name for folder in score.settings.camouflages]  # type: ignore[attr-defined]
    assert worn == ["T-Fc-0", "S-O@0.4-0", "C-Fc-seq@0.4-0", "C-Fc-par@0.4-0"]
    on_cycles = steps["score/judges.real.cycles-000"].settings
    assert on_cycles.original == Path("run/datasets/test-cycles")  # type: ignore[attr-defined]
    assert set(score.outputs) <= set(steps["report/report"].inputs)
    assert not [name for name in steps_of(cycles=False) if "judges" in name and "cycles" in name]
    # Whatever tables are called, no two steps are.
    reproduction_plan(
        PRESET, Path(), blender=BLENDER, held_out=dict.fromkeys(("a", "a-cycles"), ("yolov5",))
    )


def test_a_finished_run_is_given_only_what_held_out_detectors_add(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    layout = PaperLayout(run)
    given = read_held_out([str(detector(tmp_path / "first"))])
    store_detectors(layout, PRESET, new_tables(layout, PRESET, given))
    for age, finished in enumerate(reproduction_plan(PRESET, Path()).steps):
        leave(run, [finished], 1000 + age)
    card = layout.table("judges").detector("retinanet") / "detector.json"
    os.utime(card, (1500, 1500))
    counted, said = dry_run(run, TINY_FILE)
    assert counted == {"score": 2, "report": 1, "all": 1, "total": 4}, said
    assert "skyproof.reproduction step score/judges.judges.000 >" in said
    # The step's own process finds them where they lie.
    monkeypatch.chdir(run)
    steps = {step.id: step.settings for step in plan_of_run().steps}
    score = steps["score/judges.judges.000"]
    assert score.detectors == (Path("judges/judges/detectors/retinanet"),)  # type: ignore[attr-defined]
    assert score.out == Path("judges/judges/scores/000")  # type: ignore[attr-defined]
    monkeypatch.chdir(tmp_path / "empty")
    # Once these are there, too, nothing is left.
    with_tables = reproduction_plan(PRESET, Path(), held_out=stored_tables(layout))
    leave(run, [step for step in with_tables.steps if "judges" in step.name], 2000)
    leave(run, with_tables.steps[-1:], 3000)
    counted, said = dry_run(run, TINY_FILE)
    assert counted == {}, said
    assert json.loads(TINY_FILE.read_text()) == TINY
