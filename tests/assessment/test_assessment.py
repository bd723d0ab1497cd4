"""The steps of an assessment, and the frozen suites that it consists of."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from skyproof.assessment import preparing
from skyproof.assessment.assess import assess_steps
from skyproof.assessment.command import Request
from skyproof.assessment.judging import scored_names, still_open
from skyproof.assessment.preparing import fleets, frozen_on_labels, scenes
from skyproof.assessment.run import RunEnded
from skyproof.assessment.subject import Subject
from skyproof.assessment.suite import DEMO_SUITE, read_suite
from skyproof.assessment.suite import SUITE as SUITE_FILE
from skyproof.cli.precheck import Precheck
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import REFERENCE_DETECTORS, read_card, reference_folder
from skyproof.files import file_digest
from skyproof.imagery.settings import tiling_for_images
from skyproof.layout import Layout
from skyproof.results.rows_file import flat_row
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index
from skyproof.scenes.places import RemovedVehicle
from skyproof.vehicles.fleet import Fleet
from tests.results.test_likeness import likeness

RUN = Path("run")
ASKED = {"accept": 0.2, "reject": 0.3}
SUITE = read_suite()
DEMO = read_suite(DEMO_SUITE)
WORLD = ["vehicles/fleets", "scenes/test", "render/test", "check/detectors"]
LEARNT = [f"attack/{name}" for name in SUITE.attacks]


class Box:
    name = "mine"

    def detect(self, images):
        raise AssertionError("asked")


def subject(place, *, suite=SUITE, gsd_m=0.1, black_box=None, names=("mine",), **changes):
    asked = {"imagery": (Path("photos"),), "labels": Path("labels.json"), "seed": 3, **changes}
    request = Request((place,), RUN, **asked)
    return Subject(request, suite, names, gsd_m, torch.device("cpu"), {}, black_box)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "mine"
    place.mkdir()
    return place


@pytest.fixture
def file(tmp_path):
    place = tmp_path / "best.pt"
    place.touch()
    return place


def ids(its):
    return [step.id for step in assess_steps(its)]


def scored(its):
    """Names of the folders that are scored, in order."""
    return [
        place.name
        for step in assess_steps(its)
        if step.kind == "score"
        for place in step.settings[1]
    ]


def test_imagery_labels_and_a_detector_folder(folder):
    steps = ids(subject(folder))
    assert steps[:3] == ["ground/tiles", "threshold/mine", "clear/clear"]
    assert steps[3:7] == WORLD
    assert steps[7 : 7 + len(LEARNT)] == LEARNT
    assert steps[-1] == "report/report"
    # The threshold is frozen on other tiles than those on which the detector is checked.
    checked = next(step for step in assess_steps(subject(folder)) if step.kind == "check")
    assert "your imagery=run/tiles/test@0.1" in checked.settings[-1]


@pytest.mark.parametrize(("count", "frozen"), [(19, False), (20, True)])
def test_few_labels_leave_a_detector_folder_its_own_threshold(
    tmp_path, monkeypatch, capsys, count, frozen
):
    monkeypatch.chdir(tmp_path)
    tiles = Dataset.of_images(
        [torch.zeros(3, 8, 8, dtype=torch.uint8)] * 2,
        [torch.tensor([[1.0, 1.0, 4.0, 4.0]]).repeat(n, 1) for n in (count - 5, 5)],
        gsd_m=0.1,
    )
    monkeypatch.setattr(Dataset, "open", lambda _: tiles)
    chosen = []
    monkeypatch.setattr(Precheck, "run", lambda _: chosen.append("labels"))
    place = Path("retinanet")
    frozen_on_labels(subject(place, names=("retinanet",)), "retinanet", place).work()
    assert chosen == ["labels"] * frozen
    if not frozen:
        kept = read_card(RUN / "detectors" / "retinanet")
        assert kept.threshold == read_card(place).threshold
        assert "19 labelled vehicles on validation tiles" in capsys.readouterr().out


def ground_with(folder, test, attack, drivable="test attack"):
    """Cleared ground with so many places; one more of each split has no heading."""
    tiles = []
    for split, count in (("test", test), ("attack", attack)):
        known = [RemovedVehicle(9.0 * n, 30.0, 0.5, "label", 4.5, 1.8) for n in range(count)]
        removed = (*known, RemovedVehicle(9.0, 60.0))
        tile = BackgroundTile(split, f"{split}.png", split, 640, 640, "a", removed=removed)
        tiles.append(replace(tile, drivable=f"{split}-map.png" if split in drivable else None))
    folder.mkdir(parents=True)
    write_index(folder, 0.1, tiles)


@pytest.mark.parametrize(
    ("test", "attack", "places"),
    [(50, 25, "removed"), (49, 25, "drivable"), (60, 24, "drivable"), (0, 0, "drivable")],
)
def test_vehicles_stand_where_labelled_ones_did_if_there_are_enough(
    folder, tmp_path, monkeypatch, test, attack, places
):
    monkeypatch.chdir(tmp_path)
    ground_with(RUN / "backgrounds", test, attack)
    assert subject(folder).places == places
    ground_with(tmp_path / "other" / RUN / "backgrounds", 0, 0, "attack")
    monkeypatch.chdir(tmp_path / "other")
    assert subject(folder).places == "uniform"
    assert subject(folder, imagery=(), labels=None).places == "uniform"


@pytest.mark.parametrize(("vehicles", "own"), [(20, True), (19, False), (0, False)])
def test_the_fleet_wears_paints_of_enough_labelled_vehicles(
    folder, tmp_path, monkeypatch, capsys, vehicles, own
):
    monkeypatch.chdir(tmp_path)
    ground_with(RUN / "backgrounds", vehicles, 0)
    ground_with(RUN / "tiles", 0, 0)
    for split in ("test", "attack"):
        image = torch.full((3, 640, 640), 120, dtype=torch.uint8)
        tile = BackgroundTile(split, f"{split}.png", split, 640, 640, "a")
        save_tile(RUN / "tiles", tile, image)
    small = replace(SUITE, vehicles=(1, 1, 1, 3))
    fleets(subject(folder, suite=small), Layout(RUN)).work()
    fleet = Fleet.load(RUN / "fleets" / "test")
    assert [source.get("paint") for source in fleet.sources.values()] == [
        "of a labelled vehicle"
    ] * (3 * own)
    assert ("have the usual paints" in capsys.readouterr().out) != own


def test_a_run_stops_where_no_verdict_is_possible_any_more(tmp_path):
    """Unless the user insists, or has all results already."""
    place = tmp_path / "run/detectors/mine"
    shutil.copytree(reference_folder("retinanet"), place)
    record = json.loads((place / "precheck.json").read_text())
    # As if nothing surely hid vehicles from it.
    for rate in record["rates"]:
        rate["easr_low"] = min(rate["easr_low"], 0.0)

    def stop(easr, **changes):
        record["rates"][0] |= {"easr": easr, "easr_low": easr - 0.02, "easr_high": easr + 0.02}
        (place / "precheck.json").write_text(json.dumps(record))
        its = subject(place, **ASKED, **changes)
        its = replace(its, request=replace(its.request, out=tmp_path / "run"))
        still_open(its, its.request.requirement).work()
        return json.loads((tmp_path / "run/open.json").read_text())

    assert stop(0.02) == {"failed": []}
    (tmp_path / "run/open.json").unlink()
    for _ in range(2):
        # The same command does not get past it.
        with pytest.raises(RunEnded, match="give the same command with --go-on"):
            stop(0.6)
        assert not (tmp_path / "run/open.json").exists()
    (ruled,) = json.loads((tmp_path / "run/verdict.json").read_text())["detectors"]
    assert ruled["answer"] == "not applicable"
    assert "it failed the precheck: 1 of 27 plain paints on" in ruled["sentences"][0]
    assert "No verdict on" in (tmp_path / "run/report.html").read_text()
    (failed,) = stop(0.6, go_on=True)["failed"]
    assert failed.startswith("mine: ")
    score = tmp_path / "run/scores/test-0/score.json"
    score.parent.mkdir(parents=True)
    score.touch()
    assert stop(0.6) == {"failed": [failed]}
    names = ids(subject(place, **ASKED))
    assert names.index("size/open") == names.index("check/detectors") + 1
    assert "size/open" not in ids(subject(place))
    shutil.rmtree(tmp_path / "run/scores")
    record["likeness"] = [flat_row(likeness(0.4, 0.8))]
    with pytest.raises(RunEnded, match="does not see rendered vehicles like photographed ones"):
        stop(0.02)
    (ruled,) = json.loads((tmp_path / "run/verdict.json").read_text())["detectors"]
    assert ruled["answer"] == "not valid for this imagery"
    titles = {step.id: step.title for step in assess_steps(subject(place, **ASKED))}
    assert titles["size/size"] == "count the test tiles"
    assert titles["size/open"] == "judge the prechecks"
    assert titles["attack/T-U"] == "attack T-U"


def test_a_checkpoint_is_imported_on_the_labelled_tiles(file):
    its = subject(file, vehicle_classes=("car",))
    assert ids(its)[:3] == ["ground/tiles", "import/mine", "clear/clear"]
    brought = [*assess_steps(its)][1]
    assert RUN / "tiles/validation" in brought.settings


def test_without_labels_a_folder_keeps_its_threshold_and_a_checkpoint_gets_one_on_renders(
    folder, file
):
    steps = ids(subject(folder, labels=None))
    assert steps[:3] == ["ground/tiles", "detector/mine", "clear/clear"]
    steps = ids(subject(file, labels=None, vehicle_classes=("car",)))
    world = ["ground/threshold-ground", "vehicles/threshold-fleets"]
    world += ["scenes/threshold-validation", "render/threshold-validation"]
    assert steps[1:7] == [*world, "import/mine", "clear/clear"]


def test_without_imagery_ground_is_drawn(folder):
    steps = ids(subject(folder, imagery=(), labels=None))
    assert steps[:2] == ["ground/ground", "detector/mine"]
    assert steps[2:6] == WORLD


def test_a_requirement_counts_the_ground_first_and_reaches_the_report(folder):
    its = subject(folder, **ASKED)
    steps = ids(its)
    assert steps.index("size/size") == steps.index("scenes/test") + 1
    report = [*assess_steps(its)][-1]
    assert {key: report.settings[key] for key in ASKED} == ASKED


def test_every_attack_is_scored_beside_its_controls(folder):
    names = scored(subject(folder))
    assert len(names) == len(set(names))
    for name in SUITE.names:
        assert str(name) in names
        plain, best, search, *pattern = name.chosen_controls
        assert bool(pattern) == (name.constraints is not None)
        searches = [str(search.with_repeat(number)) for number in range(SUITE.searches)]
        assert {str(plain), str(best), *searches, *map(str, pattern)} <= set(names)
        draws = [str(name.control.with_repeat(draw)) for draw in range(SUITE.draws)]
        assert set(draws) <= set(names)


def test_ground_without_vehicles_is_shown_once(folder):
    steps = [*assess_steps(subject(folder))]
    order = [step.id for step in steps]
    first, *others = (step for step in steps if step.kind == "score")
    assert order.index("scenes/empty") < order.index("render/empty") < order.index(first.id)
    frames = [
        any("datasets/empty" in each for each in step.settings[3]) for step in (first, *others)
    ]
    assert frames == [True, *[False] * len(others)]


def test_the_scored_camouflages_of_the_suite_are_without_those_on_cycles(folder):
    its = subject(folder)
    names = scored_names([*assess_steps(its)])
    assert names == scored(its)
    path_traced = replace(its, request=replace(its.request, cycles=True))
    assert scored_names([*assess_steps(path_traced)]) == names


def test_a_black_box_is_attacked_by_queries_from_what_others_taught(folder):
    its = subject(folder, gsd_m=0.125, black_box=BlackBoxDetector(Box()))
    order = ids(its)
    assert order[:3] == ["ground/tiles", "threshold/mine", "clear/clear"]
    by_id = {step.id: step for step in assess_steps(its)}
    for name in SUITE.names:
        taught = f"attack/{name.with_variant('transfer')}"
        assert order.index(taught) < order.index(f"ask/{name}")
        assert REFERENCE_DETECTORS in by_id[taught].settings
        assert f"{name}_transfer" in by_id[f"ask/{name}"].settings
    searches = [id for id in order if id.endswith("_search")]
    assert searches
    assert all(id.startswith("ask/") for id in searches)
    kept = {"T-U_transfer", "T-U_asked1500", "T-U_asked3000", "R-U_search_asked1500"}
    assert kept < set(scored(its))


def test_gradients_are_compared_with_queries_where_references_see_the_same(folder):
    order = ids(subject(folder, gsd_m=0.125))
    for text in SUITE.compared:
        assert f"attack/{text}_transfer" in order
        assert f"ask/{text}_asked" in order
    assert sum(id.startswith("ask/") for id in order) == len(SUITE.compared)
    assert not any(id.startswith("ask/") for id in ids(subject(folder)))


def test_several_detectors_are_attacked_together(folder):
    names = ("retinanet", "faster_rcnn")
    its = subject(folder, gsd_m=0.125, names=names)
    its = replace(its, request=replace(its.request, detectors=(folder, folder)))
    steps = [*assess_steps(its)]
    assert [step.name for step in steps if step.kind == "threshold"] == [*names]
    assert all(names in step.settings for step in steps if step.kind in ("attack", "choose"))
    assert not any(step.kind == "ask" for step in steps)


def test_the_demo_takes_detectors_as_they_come(folder):
    its = subject(folder, suite=DEMO, gsd_m=0.125, imagery=(), labels=None)
    chosen = [
        *("R-U_plain", "R-U_best", *(f"R-U_search-{start}" for start in range(5))),
        *("R-U_pattern", "R-Ma_plain", "R-PixFcMa_best"),
        *(*(f"R-PixFcMa_search-{start}" for start in range(5)), "R-Ma_pattern"),
    ]
    assert ids(its) == [
        *("ground/ground", "detector/mine", "vehicles/fleets", "scenes/test", "render/test"),
        *("attack/T-U", "attack/T-PixFcMa", *(f"choose/{name}" for name in chosen)),
        *("control/random", "scenes/empty", "render/empty"),
        *("score/test-0", "score/test-1", "report/report"),
    ]
    assert scored(its)[:18] == ["T-U", "T-PixFcMa", *chosen]
    # A search has the steps of the attack that it stands beside, and each begins elsewhere.
    by_name = {step.name: step for step in assess_steps(its)}
    attack = by_name["T-PixFcMa"].settings
    searches = [by_name[f"R-PixFcMa_search-{start}"].settings for start in range(5)]
    assert [each[0] for each in searches] == [
        replace(attack[0], seed=its.seed + start) for start in range(5)
    ]
    assert {each[1:] for each in searches} == {attack[1:]}
    assert (its.image_px, its.attack_px) == (160, 128)
    path_traced = replace(its, request=replace(its.request, cycles=True))
    assert scored(path_traced)[-18:] == ["T-U", "T-PixFcMa", *chosen]


def test_cycles_adds_steps_and_changes_none(folder):
    its = subject(folder)
    more = ids(replace(its, request=replace(its.request, cycles=True)))
    assert [step for step in more if step in ids(its)] == ids(its)
    assert sorted(set(more) - set(ids(its))) == ["render/test-cycles", "score/test-cycles"]


@pytest.mark.parametrize(
    ("gsd_m", "image_px", "attack_px"), [(0.125, 192, 128), (0.3, 96, 96), (0.05, 480, 320)]
)
def test_images_cover_the_same_ground_at_every_resolution(gsd_m, image_px, attack_px):
    its = subject(Path("mine"), gsd_m=gsd_m)
    assert (its.image_px, its.attack_px) == (image_px, attack_px)


def test_drawn_ground_is_enough_for_its_false_alarms():
    area_km2 = SUITE.empty_images * SUITE.image_m**2 / 1e6
    # Chance moves 30 false alarms by a fifth, and 3 are the fewest that choose a threshold.
    assert 100 * area_km2 > 30
    assert 10 * area_km2 > 3
    side_m = tiling_for_images(192, gsd_m=0.125, imagery=False).size_px * 0.125
    assert SUITE.tiles[3] * side_m**2 / 1e6 > area_km2


@pytest.mark.parametrize(("tiles", "images"), [(2, 13), (200, SUITE.empty_images)])
def test_no_more_empty_images_than_the_test_tiles_have_room_for(monkeypatch, tiles, images):
    its = subject(Path("mine"), imagery=(), labels=None)
    tile = Mock(width_px=its.image_px * 5 // 2, height_px=its.image_px * 5 // 2)
    ground = Mock(tiles={"test": [tile] * tiles}.__getitem__)
    monkeypatch.setattr(preparing.BackgroundSet, "open", lambda folder: ground)
    drawn = Mock()
    monkeypatch.setattr(preparing, "draw_scenes", drawn)
    scenes(its, its.layout, "empty").work()
    scenes(its, its.layout, "test").work()
    assert [call.kwargs["count"] for call in drawn.mock_calls] == [images, SUITE.test_images]


def test_version_ten_is_frozen():
    """Another suite is another version: numbers of one cannot be compared with the other's."""
    assert SUITE.version == 10
    assert (
        file_digest(SUITE_FILE)
        == "4275a4c0349903fd05082c33b24498f98764c885749f516e4842358dafe81682"
    )


def test_what_each_attack_reached_is_stored_with_the_suite():
    assert set(SUITE.expected) == set(REFERENCE_DETECTORS)
    for of_attack in SUITE.expected.values():
        assert tuple(of_attack) == SUITE.attacks
        assert all(0 < one.low < one.easr <= one.high <= 1 for one in of_attack.values())
