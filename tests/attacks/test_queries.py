"""Attacks by answers alone: what they reach, what they cost, and that a stop loses nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from skyproof.attacks.objective import target_scores
from skyproof.attacks.queries import MOST_NUMBERS, CoarseChange, query_attack
from skyproof.attacks.settings import QuerySettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage, read_record
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections
from skyproof.errors import (
    ConfigurationError,
    DetectorAnswerError,
    RunFolderError,
    StoredFileError,
)
from skyproof.results.result import LENIENT_MATCH
from tests.attacks.test_kinds import BrightnessDetector, start, world

__all__ = ["world"]

FEW = QuerySettings(images=320, batch_size=2, seed=3)
KEPT = replace(FEW, keep_at=(60, 250))


class Answering:
    """The brightness detector behind a wall: no loss, no gradient; it counts what it is shown."""

    name = "answering"

    def __init__(self, stops_after: int | None = None) -> None:
        self.network = BrightnessDetector()
        self.images = 0
        self.stops_after = stops_after

    @torch.no_grad()
    def detect(self, images: Tensor) -> list[Detections]:
        self.images += len(images)
        if self.stops_after is not None and self.images > self.stops_after:
            raise DetectorAnswerError("The detector answering did not answer.")
        found = self.network.candidates(images)
        return [Detections(*pair) for pair in zip(found.boxes, found.scores, strict=True)]


def judge(detector: Answering, threshold: float = 0.6) -> BlackBoxDetector:
    return BlackBoxDetector(
        detector, card=DetectorCard("answering", threshold=threshold, gsd_m=0.125)
    )


@torch.no_grad()
def mean_score(camouflage: Camouflage, world: World) -> float:
    scenes = world.draw(24, generator=torch.Generator().manual_seed(12345))
    frames = world.frames(camouflage, scenes)
    return float(target_scores(BrightnessDetector(), frames, 0.125, LENIENT_MATCH).mean())


def finished(name: str) -> Camouflage:
    camouflage = start(name)
    camouflage.finalise()
    return camouflage.requires_grad_(False)


@pytest.fixture(scope="module")
def searched(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished search for T-Pix; not to be changed."""
    folder = tmp_path_factory.mktemp("searched") / "T-Pix"
    query_attack(finished("T-Pix"), judge(Answering()), world, KEPT, folder)
    return folder


@pytest.mark.parametrize(
    "name", ["T-PixFc", pytest.param("S-O@0.4", marks=pytest.mark.slow), "R-PixFc_search"]
)
def test_answers_alone_find_something_better(tmp_path: Path, world: World, name: str) -> None:
    before = finished(name)
    detector = Answering()
    # A shape has more to find out.
    budget = replace(FEW, images=(2 if name.startswith("S") else 1) * FEW.images)
    found = query_attack(finished(name), judge(detector), world, budget, tmp_path)
    assert mean_score(found, world) < mean_score(before, world)
    # Colours stay those of the palette.
    if isinstance(found, UniversalTexture) and isinstance(before, UniversalTexture):
        assert torch.equal(found.palette, before.palette)
        assert found.bytes().flatten(1).unique(dim=1).shape[1] <= len(before.palette)
        assert not torch.equal(found.bytes(), before.bytes())
    assert str(load_camouflage(tmp_path).name) == str(found.name) == name
    asked = read_record(tmp_path)["queries"]
    assert budget.images - 40 < asked["images"] <= budget.images
    assert asked["images"] == detector.images
    if not found.name.random:
        assert asked["judged"]["scenes"] == 16


def test_a_search_from_nothing_that_found_more_is_taken(tmp_path: Path, world: World) -> None:
    black = finished("R-Pix_search")
    with torch.no_grad():
        black.cells.zero_()
    start, detector = finished("T-Pix"), judge(Answering())
    found = query_attack(start, detector, world, FEW, tmp_path / "T-Pix", rival=black)
    assert [str(each.name) for each in (found, black)] == ["T-Pix", "R-Pix_search"]
    assert not found.bytes().any()
    asked = read_record(tmp_path / "T-Pix")["queries"]["judged"]
    assert asked["rival_hides"] >= max(asked["hides"], asked["start_hides"])
    with pytest.raises(RunFolderError):
        query_attack(start, detector, world, FEW, tmp_path / "T-Pix")


def test_a_search_is_never_a_step_back(tmp_path: Path, world: World) -> None:
    # Nothing is darker than black: whatever is tried, the start stays.
    black = finished("T-Pix")
    with torch.no_grad():
        black.cells.zero_()
    found = query_attack(black, judge(Answering()), world, FEW, tmp_path)
    judged = read_record(tmp_path)["queries"]["judged"]
    assert judged["hides"] <= judged["start_hides"]
    assert torch.equal(found.cells, black.cells)


def test_a_stopped_search_ends_where_it_would_have_and_asks_nothing_twice(
    tmp_path: Path, searched: Path, world: World
) -> None:
    straight = load_camouflage(searched)
    assert isinstance(straight, UniversalTexture)
    first = Answering(stops_after=170)
    with pytest.raises(DetectorAnswerError):
        query_attack(finished("T-Pix"), judge(first), world, FEW, tmp_path / "stopped")
    second = Answering()
    found = query_attack(finished("T-Pix"), judge(second), world, FEW, tmp_path / "stopped")
    assert isinstance(found, UniversalTexture)
    assert torch.equal(found.cells, straight.cells)
    # Of the generation that was under way, the answers are lost.
    generation = 11 * FEW.batch_size
    whole = read_record(searched)["queries"]["images"]
    assert first.images + second.images <= whole + generation
    rows = [
        [json.loads(line)["scores"] for line in (folder / "steps.jsonl").open()]
        for folder in (searched, tmp_path / "stopped")
    ]
    assert rows[0] == rows[1]


def test_copies_are_kept_on_the_way(searched: Path, world: World) -> None:
    kept = sorted((searched / "snapshots").iterdir())
    assert [each.name for each in kept] == ["T-Pix_asked250", "T-Pix_asked60"]
    later, earlier = kept
    assert read_record(earlier)["images"] == 66
    assert read_record(later)["images"] == 264
    scores = [mean_score(load_camouflage(each), world) for each in (earlier, later)]
    assert scores[1] < scores[0]


def test_a_finished_search_asks_nothing(searched: Path, world: World) -> None:
    silent = Answering(stops_after=0)
    again = query_attack(finished("T-Pix"), judge(silent), world, KEPT, searched)
    assert silent.images == 0
    assert torch.equal(again.cells, load_camouflage(searched).cells)
    with pytest.raises(RunFolderError, match="a search with other settings"):
        query_attack(finished("T-Pix"), judge(silent, 0.5), world, KEPT, searched)


def test_a_detector_that_finds_nothing_cannot_be_attacked(tmp_path: Path, world: World) -> None:
    with pytest.raises(ConfigurationError, match="finds no vehicle"):
        query_attack(finished("T-Pix"), judge(Answering(), 0.999), world, FEW, tmp_path)


def test_a_budget_for_less_than_one_generation_is_refused(tmp_path: Path, world: World) -> None:
    with pytest.raises(ConfigurationError, match="at least 70 images to be queried, got 69"):
        query_attack(
            finished("T-Pix"), judge(Answering()), world, replace(FEW, images=69), tmp_path
        )


@pytest.mark.parametrize(
    ("scores", "words"), [("[0.5]", "are 1 instead of 11"), ("[2.0]", "scores"), ("null", "scores")]
)
def test_answers_that_were_changed_are_refused(
    tmp_path: Path, world: World, scores: str, words: str
) -> None:
    with pytest.raises(DetectorAnswerError):
        query_attack(finished("T-Pix"), judge(Answering(stops_after=40)), world, FEW, tmp_path)
    log = tmp_path / "steps.jsonl"
    row = json.loads(log.read_text())
    log.write_text(json.dumps({**row, "scores": json.loads(scores)}) + "\n")
    with pytest.raises(StoredFileError, match=words):
        query_attack(finished("T-Pix"), judge(Answering()), world, FEW, tmp_path)


@pytest.mark.parametrize("name", ["T-Pix", "S-O@0.4", "C-PixFc-seq@0.3"])
def test_no_change_is_the_start_and_a_few_numbers_change_it(name: str) -> None:
    before = finished(name)
    change = CoarseChange(before)
    assert 8 <= change.count <= MOST_NUMBERS
    same = change(np.zeros(change.count))
    other = change(np.linspace(-1, 1, change.count))
    part = "shape.reach" if name.startswith("C") else "reach" if name[0] == "S" else "cells"
    values = [each.state_dict()[part] for each in (before, same, other)]
    assert torch.equal(values[0], values[1])
    assert float((values[0] != values[2]).float().mean()) > 0.3


@pytest.mark.parametrize("few_colours", [True, False])
def test_something_else_cannot_be_moved_by_degrees(few_colours: bool) -> None:
    class Other(Camouflage):
        name = finished("T-Pix").name

    other = finished("T-PixFc") if few_colours else Other()
    with pytest.raises(ConfigurationError, match="nothing to move by degrees"):
        CoarseChange(other)
