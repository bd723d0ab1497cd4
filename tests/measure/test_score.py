"""Matched datasets to a score folder, with a detector whose answers are known."""

import json
from dataclasses import replace

import pytest
import torch
from PIL import Image

from skyproof.camouflage.name import CamouflageName
from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError
from skyproof.measure import score as scoring
from skyproof.measure.baseline import BaselineSet
from skyproof.measure.score import score_detectors
from skyproof.results.merge import merge_counts
from skyproof.results.pairs.outcomes import MATCHES, read_outcomes
from skyproof.results.pairs.tiles import Series, count_tiles
from skyproof.results.results import Results
from skyproof.scenes.scene import write_scenes


class Brightest:
    """Finds the vehicle in the middle with the brightness of the image as its score."""

    def __init__(self, name="brightest"):
        self.name = name
        self.images = 0

    def detect(self, images):
        self.images += len(images)
        box = torch.tensor([[22.0, 22.0, 42.0, 42.0]])
        return [Detections(box, image.mean().reshape(1)) for image in images]


def score(judges, original, camouflaged, folder, *, clean=()):
    """Scores, and returns the rows that the run's results have then."""
    score_detectors(judges, folder, original=original, camouflaged=camouflaged, clean=clean)
    return [row.json() for row in Results.open(folder).rows]


def judging(detector, threshold):
    card = DetectorCard(detector.name, threshold=threshold, gsd_m=0.125)
    return LoadedDetector(detector, card)


@pytest.fixture
def make_dataset(tmp_path, make_scene):
    def make(name, brightness, vehicles=1, source=None):
        """One 64 px image per value of `brightness`, each on a tile of its own."""
        scenes = [make_scene(f"s{i}", f"tile-{i}", vehicles) for i in range(len(brightness))]
        mask = torch.zeros(64, 64, dtype=torch.bool)
        mask[22:42, 22:42] = True
        with CocoWriter(tmp_path / name, gsd_m=0.125, source=source) as writer:
            for scene, value in zip(scenes, brightness, strict=True):
                vehicle = Annotation(
                    (22.0, 22.0, 42.0, 42.0), (32.0, 32.0), 1.0, mask, "pick-up-0000", 0
                )
                image = torch.full((3, 64, 64), value, dtype=torch.uint8)
                writer.add(image, scene.id, [vehicle] * vehicles)
        write_scenes(tmp_path / name / "scenes.jsonl", scenes)
        return tmp_path / name

    return make


def test_all_that_was_found_is_written(make_dataset, tmp_path):
    original, hidden = (
        make_dataset("test", [200, 200, 200, 50]),
        make_dataset("test-T-U-0", [50, 50, 200, 200]),
    )
    judge = judging(Brightest(), 0.5)
    rows = score([judge], original, {"T-U-0": hidden}, tmp_path / "scores")
    row = next(row for row in rows if row["match"] == "centre_1m")
    assert (row["camouflage"], row["asr"], row["er"]) == (
        "T-U",
        pytest.approx(2 / 3),
        pytest.approx(1 / 3),
    )
    tiles, sets = merge_counts([tmp_path / "scores"])
    counted = count_tiles(read_outcomes(tmp_path / "scores" / "outcomes.parquet"))
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


def test_a_detector_that_finds_nothing_is_refused_before_the_long_part(make_dataset, tmp_path):
    original, hidden = make_dataset("test", [200, 200]), make_dataset("test-T-U", [50, 50])
    good, silent = Brightest("good"), Brightest("silent")
    with pytest.raises(
        ConfigurationError, match=r"silent finds none of the 2 vehicles .* threshold of 0\.9.*EASR"
    ):
        score(
            [judging(good, 0.5), judging(silent, 0.9)],
            original,
            {"T-U": hidden},
            tmp_path / "scores",
        )
    assert (good.images, silent.images) == (2, 2)
    assert not (tmp_path / "scores").exists()


def test_a_set_without_vehicles_is_refused(make_dataset, tmp_path):
    original, hidden = make_dataset("test", [200, 200], 0), make_dataset("test-T-U", [50, 50], 0)
    with pytest.raises(ConfigurationError, match="shows no vehicles to hide"):
        score([judging(Brightest(), 0.5)], original, {"T-U": hidden}, tmp_path / "scores")


def test_the_renderer_is_the_datasets_own(make_dataset, tmp_path):
    cycles = {"renderer": "cycles"}
    original = make_dataset("test", [200, 200, 200, 50], source=cycles)
    hidden = make_dataset("test-T-U", [50, 50, 200, 200], source=cycles)
    rows = score([judging(Brightest(), 0.5)], original, {"T-U": hidden}, tmp_path / "scores")
    assert {row["renderer"] for row in rows} == {"cycles"}
    tiles, sets = merge_counts([tmp_path / "scores"])
    assert (
        {key.renderer for key in tiles.series} == {score.renderer for score in sets} == {"cycles"}
    )
    assert {
        outcome.renderer for outcome in read_outcomes(tmp_path / "scores" / "outcomes.parquet")
    } == {"cycles"}


@pytest.mark.parametrize("first", ["torch", "cycles"])
def test_datasets_of_two_renderers_are_no_pairs(make_dataset, tmp_path, first):
    second = {"torch": "cycles", "cycles": "torch"}[first]
    # One that does not say it is of before there was a choice.
    sources = {"torch": None, "cycles": {"renderer": "cycles"}}
    original = make_dataset("test", [200, 200], source=sources[first])
    hidden = make_dataset("test-T-U", [50, 50], source=sources[second])
    judge = Brightest()
    with pytest.raises(
        ConfigurationError, match=rf"by {first} and .*test-T-U by {second}, .* same --renderer"
    ):
        score([judging(judge, 0.5)], original, {"T-U": hidden}, tmp_path / "scores")
    assert judge.images == 0
    assert not (tmp_path / "scores").exists()


def test_datasets_of_one_renderer_under_other_settings_are_no_pairs(make_dataset, tmp_path):
    sources = [
        {"renderer": "cycles", "rendering": {"samples": samples, "finish": "matt"}}
        for samples in (32, 64)
    ]
    original = make_dataset("test", [200, 200], source=sources[0])
    hidden = make_dataset("test-T-U", [50, 50], source=sources[1])
    with pytest.raises(
        ConfigurationError, match=r"by cycles and .* by cycles with other settings \(samples\)"
    ):
        score([judging(Brightest(), 0.5)], original, {"T-U": hidden}, tmp_path / "scores")


def test_checks_on_clean_images_say_what_they_rest_on(make_dataset, tmp_path):
    original, hidden = (
        make_dataset("test", [200, 200, 200, 50]),
        make_dataset("test-T-U", [50, 50, 200, 200]),
    )
    images = Dataset.open(original)
    # A second vehicle that is never found halves recall on the real images.
    twice = [torch.cat([boxes, boxes + 40]) for boxes in images.boxes]
    real = replace(images, boxes=twice)
    clean = [
        BaselineSet("two places", real, real=True, note="note", places=["a", "a", "b", "b"]),
        BaselineSet("one place", real, real=True, places=["a"] * 4),
        BaselineSet("unknown", real, real=True),
    ]
    score([judging(Brightest(), 0.5)], original, {"T-U": hidden}, tmp_path / "scores", clean=clean)
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


def test_a_clean_set_without_vehicles_has_no_average_precision(make_dataset, tmp_path):
    original, hidden = make_dataset("test", [200, 200]), make_dataset("test-T-U", [50, 50])
    empty = BaselineSet(
        "empty", Dataset.open(make_dataset("empty", [10, 10], vehicles=0)), real=False
    )
    score(
        [judging(Brightest(), 0.5)],
        original,
        {"T-U": hidden},
        tmp_path / "scores",
        clean=[empty],
    )
    text = (tmp_path / "scores" / "baselines.json").read_text()
    assert "NaN" not in text
    row = json.loads(text)["rows"][1]
    assert [row[key] for key in ("ap_centre_1m", "ap_centre_1m_low", "ap_iou_50", "recall")] == [
        None
    ] * 4


def test_whether_images_are_real_must_be_said(make_dataset):
    """The shipped example of a black box once reported rendered images as real ones."""
    images = Dataset.open(make_dataset("validation", [200]))
    with pytest.raises(TypeError, match="real"):
        BaselineSet("validation", images)


def test_every_dataset_is_matched_once_by_each_rule(make_dataset, tmp_path, monkeypatch):
    original = make_dataset("test", [200, 200])
    worn = {name: make_dataset(f"test-{name}", [50, 200]) for name in ("T-U", "R-U-0", "R-U-1")}
    matched = []

    def counting(found, dataset, *, criterion):
        matched.append((dataset.folder.name, criterion))
        return match_images(found, dataset, criterion=criterion)

    monkeypatch.setattr(scoring, "match_images", counting)
    score([judging(Brightest(), 0.5)], original, worn, tmp_path / "scores")
    assert len(matched) == len(set(matched)) == len(MATCHES) * (1 + len(worn))


def test_a_score_folder_has_pictures_of_what_is_shown(make_dataset, tmp_path):
    original = make_dataset("test", [200, 200, 200])
    worn = {name: make_dataset(f"test-{name}", [50, 200, 50]) for name in ("T-U", "R-U-0", "T-U-1")}
    score([judging(Brightest(), 0.5)], original, worn, tmp_path / "scores")
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
    assert not (tmp_path / "scores" / "pairs" / "R-U-0").exists()
