"""Scenes to a score folder, with a detector whose answers are known."""

import json
import time
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.maite.models import ModelDetector
from skyproof.measure import views
from skyproof.measure.baseline import BaselineSet
from skyproof.measure.measure import measure
from skyproof.measure.score import score
from skyproof.measure.views import SceneChange, SceneRenderer
from skyproof.render.frames import Frames
from skyproof.report.report import write_report
from skyproof.results.outcomes import MATCHES, Series, read_outcomes
from skyproof.results.results import Results
from skyproof.results.score_folder import ScoreFolder, merge_scores
from skyproof.scenes.scene import Placement
from tests.results.counted import count_outcomes

BOX = torch.tensor([22.0, 22.0, 42.0, 42.0])


class Brightest:
    """Finds the vehicle in the middle with the brightness of the image as its score."""

    def __init__(self, name="brightest"):
        self.name = name
        self.images = 0

    def detect(self, images):
        self.images += len(images)
        box = torch.tensor([[22.0, 22.0, 42.0, 42.0]])
        return [Detections(box, image.mean().reshape(1)) for image in images]


class Worn(Camouflage):
    """Lifts the vehicles by as many kilometres as its number says, by which `Flat` knows it."""

    def __init__(self, number):
        super().__init__()
        self.number = number

    def forward(self, vehicles):
        return replace(vehicles, vertices=vehicles.vertices + 1000 * self.number)


class Flat:
    """Draws images of one brightness, with a vehicle in the middle for each placement.

    Args:
        levels: of each image, of the vehicles as they are, and of each number of a `Worn`.
    """

    differentiable = concurrent = False

    def __init__(self, *levels, name="torch"):
        self.levels = levels
        self.name = name
        self.drawn = 0

    def record(self, scenes):
        return {}

    def __call__(self, scenes, vehicles, *, masks=False):
        self.drawn += len(scenes)
        levels = self.levels[round(vehicles.vertices.max().item() / 1000)]
        owner = [index for index, scene in enumerate(scenes) for _ in scene.placements]
        level = torch.tensor([levels[int(scene.id[1:])] / 255 for scene in scenes])
        return Frames(
            image=level.view(-1, 1, 1, 1).expand(-1, 3, 64, 64),
            scene_index=torch.tensor(owner, dtype=torch.int64),
            boxes=BOX.expand(len(owner), 4),
            centres=torch.full((len(owner), 2), 32.0),
            visible_px=torch.full((len(owner),), 400.0),
            visible_fraction=torch.ones(len(owner)),
        )


@pytest.fixture
def scored(tmp_path, make_scene, fleet):
    """Scores scenes of these levels of brightness, and gives the rows that the results have."""

    def call(detectors, original, changed, *, vehicles=1, renderer="torch", **more):
        scenes = some_scenes(make_scene, fleet, len(original), vehicles)
        drawn = Flat(original, *changed.values(), name=renderer)
        changes = [SceneChange(name, Worn(number)) for number, name in enumerate(changed, 1)]
        score(detectors, tmp_path / "scores", scenes, changes, SceneRenderer(fleet, drawn), **more)
        return [row.json() for row in Results.open(tmp_path / "scores").rows]

    return call


def some_scenes(make_scene, fleet, count, vehicles=1):
    placements = tuple(Placement(fleet.ids[0], 0.0, 0.0, 0.0) for _ in range(vehicles))
    return [replace(make_scene(f"s{i}", f"tile-{i}"), placements=placements) for i in range(count)]


def judging(detector, threshold):
    card = DetectorCard(detector.name, threshold=threshold, gsd_m=0.125)
    return BlackBoxDetector(detector, card=card)


def flat_images(levels, vehicles=1):
    images = [torch.full((3, 64, 64), level, dtype=torch.uint8) for level in levels]
    return Dataset.of_images(images, [BOX.expand(vehicles, 4)] * len(levels), gsd_m=0.125)


def test_all_that_was_found_is_written(scored, tmp_path):
    rows = scored([judging(Brightest(), 0.5)], [200, 200, 200, 50], {"T-U-0": [50, 50, 200, 200]})
    row = next(row for row in rows if row["match"] == "centre_1m")
    assert (row["camouflage"], row["asr"], row["er"]) == (
        "T-U",
        pytest.approx(2 / 3),
        pytest.approx(1 / 3),
    )
    tiles, sets = merge_scores([ScoreFolder.open(tmp_path / "scores")])
    counted = count_outcomes(read_outcomes(tmp_path / "scores" / "outcomes.parquet"))
    key = Series("T-U-0", "torch", "brightest", "centre_1m")
    expected = [[1, 0, 1, 0], [1, 0, 1, 0], [1, 1, 0, 0], [1, 0, 0, 1]]
    assert tiles.series[key].tolist() == counted.series[key].tolist() == expected
    assert [score.camouflage for score in sets if score.match == "centre_1m"] == [
        "original",
        "T-U-0",
    ]
    results = Results.open(tmp_path / "scores")
    results.write()
    assert json.loads((tmp_path / "scores" / "results.json").read_text())["rows"] == rows


class DayOrNight(Detector):
    """Takes a bright vehicle for one, and a dark one for another class."""

    def __init__(self):
        self.set_card(DetectorCard("mine", threshold=0.6, gsd_m=0.125))
        self.dark = False

    def detect(self, images):
        scores = [image.mean().reshape(1) for image in images]
        return [Detections(BOX[None], 1 - one if self.dark else one) for one in scores]

    def of_other_classes(self):
        twin = DayOrNight()
        twin.dark = True
        return twin


def day_or_night(images):
    levels = [float(np.asarray(image).mean()) for image in images]
    labels, boxes = np.array([1, 0]), BOX.expand(2, 4).numpy()
    return [
        SimpleNamespace(boxes=boxes, labels=labels, scores=np.array([level, 1 - level]))
        for level in levels
    ]


def black_box():
    card = DetectorCard("mine", threshold=0.6, gsd_m=0.125)
    return BlackBoxDetector(day_or_night, card=card, vehicle_classes=["1"])


def maite_model():
    def model(images):
        return day_or_night(images)

    model.metadata = {"id": "mine", "index2label": {0: "tree", 1: "vehicle"}}
    card = DetectorCard("mine", threshold=0.6, gsd_m=0.125)
    return BlackBoxDetector(ModelDetector(model, vehicle_classes=["vehicle"]), card=card)


@pytest.mark.parametrize("detector", [DayOrNight, black_box, maite_model])
def test_vehicles_called_another_class_are_counted_apart_from_those_that_vanish(
    detector, scored, tmp_path
):
    # Of four vehicles found before, one is called another class and one is nothing.
    levels = {"T-U-0": [50, 127, 200, 200, 50], "R-U-0": [50, 50, 50, 50, 50]}
    rows = scored([detector()], [200, 200, 200, 200, 50], levels)
    known = {(row["camouflage"], row["match"]): row["called_another_class"] for row in rows}
    assert known.pop(("T-U", "centre_in_box")) == 0.25
    assert set(known.values()) == {None}
    (baseline,) = Results.open(tmp_path / "scores").baselines
    assert baseline.called_another_class == 0.2
    assert baseline.leniently.endswith("recall 80\u202f%, called another class 20\u202f%")
    page = write_report(tmp_path / "scores").read_text()
    assert "On 25\u202f% of the vehicles found before only another class is detected." in page


def test_the_next_change_is_drawn_while_the_caller_looks_at_a_view(make_scene, fleet):
    renderer = Flat([200], [50], [50])
    stage, scenes = SceneRenderer(fleet, renderer), some_scenes(make_scene, fleet, 1)
    changes = [SceneChange("T-U", Worn(1)), SceneChange("R-U-0", Worn(2))]
    seen = views.views(
        [judging(Brightest("one"), 0.5)], scenes, changes, stage, progress=lambda _: None
    )
    names = [next(seen).name]
    for later in (2, 3):
        deadline = time.monotonic() + 20
        while renderer.drawn < later and time.monotonic() < deadline:
            time.sleep(0.01)
        assert renderer.drawn == later
        names.append(next(seen).name)
    assert names == ["original", "T-U", "R-U-0"]
    assert next(seen, None) is None


def test_batches_are_let_go_before_their_view_is_whole(make_scene, fleet):
    drawn = []

    class Remembering(Flat):
        def __call__(self, scenes, vehicles, *, masks=False):
            frames = super().__call__(scenes, vehicles, masks=masks)
            drawn.append(weakref.ref(frames))
            return frames

    stage = SceneRenderer(fleet, Remembering([200] * 20))
    detectors = [judging(Brightest("one"), 0.5)]
    scenes = some_scenes(make_scene, fleet, 20)
    seen = views.views(detectors, scenes, [], stage, progress=lambda _: None)
    assert len(next(seen).images) == len(drawn) * 8 - 4
    # The last batch goes with the next view.
    assert [frames() for frames in drawn[:-1]] == [None] * 2


def test_other_classes_of_the_unchanged_scenes_are_asked_for_on_request(make_scene, fleet):
    stage, detector = SceneRenderer(fleet, Flat([200] * 3)), black_box()
    scenes = some_scenes(make_scene, fleet, 3)
    for wanted in (False, True):
        asked = views.views(
            [detector], scenes, [], stage, other_classes=wanted, progress=lambda _: None
        )
        (view,) = asked
        assert (view.called_another_class(detector) is not None) == wanted


def test_outcomes_are_the_same_with_and_without_a_folder(tmp_path, make_scene, fleet):
    scenes = some_scenes(make_scene, fleet, 3)
    detectors = [judging(Brightest("one"), 0.5), judging(Brightest("other"), 0.6)]
    worn = {"T-U": Worn(1), "R-U-0": Worn(2)}
    renderer = Flat([200, 200, 200], [50, 200, 200], [200, 200, 200])
    world = {"fleet": fleet, "renderer": renderer}
    outcomes = measure(detectors, scenes, worn, **world)
    assert [(one.detector, one.camouflage) for one in outcomes[:: 3 * len(MATCHES)]] == [
        (detector, name) for detector in ("one", "other") for name in worn
    ]
    assert measure(detectors, scenes, worn, folder=tmp_path / "scores", **world) == outcomes
    assert read_outcomes(tmp_path / "scores" / "outcomes.parquet") == outcomes


def test_images_that_were_drawn_otherwise_are_no_pairs(scored, tmp_path):
    unchanged = replace(flat_images([200, 200]), ids=["s0", "s1"])
    with pytest.raises(ConfigurationError, match="not by torch; give --renderer"):
        scored([judging(Brightest(), 0.5)], [0, 0], {"T-U": [50, 200]}, unchanged=unchanged)
    with pytest.raises(StoredFileError, match="other images or vehicles than its scenes"):
        scored([judging(Brightest(), 0.5)], [0], {"T-U": [50]}, unchanged=unchanged)
    assert not (tmp_path / "scores").exists()


@pytest.mark.parametrize(
    ("vehicles", "words"),
    [
        (1, r"silent finds none of the 2 vehicles .* threshold of 0\.9.*EASR"),
        (0, "scenes with vehicles, got 2 scenes without any"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_the_long_part(scored, tmp_path, vehicles, words):
    good, silent = Brightest("good"), Brightest("silent")
    detectors = [judging(good, 0.5), judging(silent, 0.9)]
    with pytest.raises(ConfigurationError, match=words):
        scored(detectors, [200, 200], {"T-U": [50, 50]}, vehicles=vehicles)
    assert good.images == silent.images == 2 * vehicles
    assert not (tmp_path / "scores").exists()


@pytest.mark.parametrize(
    ("detectors", "names", "words"),
    [
        (["one", "one"], ["T-U"], "Two detectors are called 'one'"),
        (["one"], ["T-U", "T-U"], "Two camouflages are called 'T-U'"),
    ],
)
def test_two_of_one_name_are_refused(tmp_path, make_scene, fleet, detectors, names, words):
    scenes = some_scenes(make_scene, fleet, 1)
    changes = [SceneChange(name, Worn(1)) for name in names]
    known = [judging(Brightest(name), 0.5) for name in detectors]
    with pytest.raises(ConfigurationError, match=words):
        score(known, tmp_path / "scores", scenes, changes, SceneRenderer(fleet, Flat([200], [50])))


def test_the_renderer_is_the_stages_own(scored, tmp_path):
    rows = scored([judging(Brightest(), 0.5)], [200, 50], {"T-U": [50, 200]}, renderer="cycles")
    assert {row["renderer"] for row in rows} == {"cycles"}
    tiles, sets = merge_scores([ScoreFolder.open(tmp_path / "scores")])
    assert {key.renderer for key in tiles.series} == {one.renderer for one in sets} == {"cycles"}
    (check,) = json.loads((tmp_path / "scores" / "baselines.json").read_text())["rows"]
    assert check["dataset"] == "Blender Cycles test"


def test_false_alarms_on_rendered_ground_without_vehicles_keep_their_scores(scored, tmp_path):
    images = flat_images([153, 204, 102, 51], vehicles=0)
    sets = [
        BaselineSet("empty", images, real=False, places=("a", "b", "b", "a")),
        BaselineSet("photographs", images, real=True),
        BaselineSet("driven on", flat_images([204] * 4), real=False),
    ]
    scored([judging(Brightest(), 0.5)], [200], {"T-U": [50]}, baselines=sets)
    folder = ScoreFolder.open(tmp_path / "scores")
    empty, *others = (row for row in folder.baselines() if row.dataset != "rendered test")
    # Four images of 8 m: less than one alarm is allowed, so the two highest scores are kept.
    assert empty.area_km2 == pytest.approx(4 * 64 / 1e6)
    assert empty.alarm_scores == pytest.approx((0.8, 0.6))
    assert empty.alarm_clusters == (1, 0)
    assert empty.false_alarms_per_km2 == pytest.approx(2 / empty.area_km2)
    assert [row.alarm_scores for row in others] == [(), ()]


def test_baselines_say_what_they_rest_on(scored, tmp_path):
    images = flat_images([200, 200, 200, 50])
    # A second vehicle that is never found halves recall on the real images.
    real = replace(images, boxes=[torch.cat([boxes, boxes + 40]) for boxes in images.boxes])
    sets = [
        BaselineSet("two places", real, real=True, note="note", places=["a", "a", "b", "b"]),
        BaselineSet("one place", real, real=True, places=["a"] * 4),
        BaselineSet("unknown", real, real=True),
    ]
    changed = {"T-U": [50, 50, 200, 200]}
    scored([judging(Brightest(), 0.5)], [200, 200, 200, 50], changed, baselines=sets)
    rows = {
        row["dataset"]: row
        for row in json.loads((tmp_path / "scores" / "baselines.json").read_text())["rows"]
    }
    assert list(rows) == ["rendered test", "two places", "one place", "unknown"]
    assert {name: row["real"] for name, row in rows.items()} == {
        name: name != "rendered test" for name in rows
    }
    rests = {name: (row["clustered_by"], row["clusters"]) for name, row in rows.items()}
    assert rests == {
        "rendered test": ("places", 4),
        "two places": ("places", 2),
        "one place": ("images", 4),
        "unknown": ("images", 4),
    }
    row = rows["two places"]
    # Four of eight vehicles, three of these above the threshold; precision 1 up to a recall of 0.5.
    assert (row["vehicles"], row["recall"], row["precision"], row["note"]) == (
        8,
        3 / 8,
        1.0,
        "note",
    )
    assert row["ap_centre_1m"] == pytest.approx(51 / 101)
    assert row["ap_centre_1m_low"] < 51 / 101 < row["ap_centre_1m_high"]
    # Two places leave Student's t one degree of freedom.
    assert row["ap_centre_1m_high"] - row["ap_centre_1m_low"] > 0.3


def test_a_set_without_vehicles_has_no_average_precision(tmp_path):
    empty = BaselineSet("empty", flat_images([10, 10], vehicles=0), real=False)
    assert score([judging(Brightest(), 0.5)], tmp_path / "scores", baselines=[empty]) == []
    text = (tmp_path / "scores" / "baselines.json").read_text()
    assert "NaN" not in text
    (row,) = json.loads(text)["rows"]
    assert [row[key] for key in ("ap_centre_1m", "ap_centre_1m_low", "ap_iou_50", "recall")] == [
        None
    ] * 4


def test_whether_images_are_real_must_be_said():
    """The shipped example of a black box once reported rendered images as real ones."""
    with pytest.raises(TypeError, match="real"):
        BaselineSet("validation", flat_images([200]))


def test_every_view_is_matched_once_by_each_rule(scored, monkeypatch):
    matched = []

    def counting(found, dataset, *, criterion):
        matched.append(criterion)
        return match_images(found, dataset, criterion=criterion)

    monkeypatch.setattr(views, "match_images", counting)
    worn = {name: [50, 200] for name in ("T-U", "R-U-0", "R-U-1")}
    scored([judging(Brightest(), 0.5)], [200, 200], worn)
    assert len(matched) == len(MATCHES) * (1 + len(worn))


def test_a_score_folder_has_pictures_of_what_is_shown(scored, tmp_path):
    worn = {name: [50, 200, 50] for name in ("T-U", "R-U-0", "T-U-1")}
    scored([judging(Brightest(), 0.5)], [200, 200, 200], worn)
    pairs = Results.open(tmp_path / "scores").pairs(CamouflageName.read("T-U"), "torch")
    assert {pair.camouflage for _, pair in pairs} == {"T-U"}
    assert {(pair.scene, pair.found_before, pair.found_after) for _, pair in pairs} == {
        ("s0", 1, 0),
        ("s1", 1, 1),
        ("s2", 1, 0),
    }
    for folder, pair in pairs:
        with Image.open(folder / pair.adversarial) as picture:
            assert picture.size == (128, 128)
            # The frame around the vehicle says whether it was found.
            red, green, _ = picture.convert("RGB").getpixel((40, 64))
            assert (green > red) == bool(pair.found_after)
            level = 200 if pair.found_after else 50
            assert picture.getpixel((4, 4)) == pytest.approx((level,) * 3, abs=3)
    assert not (tmp_path / "scores" / "pairs" / "R-U-0").exists()
