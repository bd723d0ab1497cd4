"""Photographed and rendered vehicles of known scores, from both sides to a verdict."""

from dataclasses import replace

import jaxtyping
import numpy as np
import pytest
import torch
from scipy import stats

from skyproof.datasets.dataset import Dataset
from skyproof.measure.baseline import BaselineSet
from skyproof.measure.likeness import _recalls, _Seen, compare_kinds
from skyproof.measure.score import score
from skyproof.measure.views import SceneChange, SceneRenderer, look
from skyproof.results.likeness import FEWEST_TILES, LARGEST_DIFFERENCE, Look
from skyproof.results.results import Results
from skyproof.results.statistics.intervals import resample
from tests.measure.test_score import BOX, Brightest, Flat, Worn, flat_images, judging, some_scenes

SURE = [220, 230, 240, 225, 235, 245]


def photographs(levels, *, boxes=BOX, real=True, name="tile-{}"):
    """Tiles of one brightness each, with a labelled vehicle; `Brightest` scores by brightness."""
    images = replace(flat_images(levels), boxes=[boxes.view(-1, 4)] * len(levels))
    names = [name.format(number) for number in range(len(levels))]
    return BaselineSet("yours", replace(images, ids=names), real=real, places=names)


@pytest.fixture
def compared(make_scene, fleet):
    """The rows of a detector with a threshold of 0.5, by rule."""

    def call(photographed, rendered, **given):
        scenes, detector = some_scenes(make_scene, fleet, len(rendered)), judging(Brightest(), 0.5)
        yours = photographs(photographed, **given)
        shown = flat_images(rendered)
        views = [
            look([detector], "any", images, other_classes=False) for images in (yours.images, shown)
        ]
        rows = compare_kinds([detector], yours, views[0], scenes, views[1], seed=0)
        return {row.match: row for row in rows}

    return call


def test_recalls_medians_and_the_chance_of_a_larger_score(compared):
    row = compared([204, 204, 51, 102, 255, 153], [153, 153, 153, 51, 255, 51])["centre_1m"]
    assert (row.tiles, row.photographed, row.rendered) == (6, 6, 6)
    assert row.recall_photographed.estimate == pytest.approx(4 / 6)
    assert row.recall_rendered.estimate == pytest.approx(4 / 6)
    assert row.recall_difference.estimate == pytest.approx(0.0)
    assert row.median_photographed == pytest.approx(0.7)
    assert row.median_rendered == pytest.approx(0.6)
    # Of 36 pairs, 19 have a larger photographed score and 6 are equal.
    assert row.higher.estimate == pytest.approx((19 + 6 / 2) / 36)
    assert row.higher.low < row.higher.estimate < row.higher.high
    assert row.state == "unknown"


def test_a_vehicle_that_is_not_found_has_no_score(compared):
    """The detections lie in the boxes, 1.25 m off their centres."""
    rows = compared(SURE, SURE, boxes=torch.tensor([[10.0, 22.0, 34.0, 42.0]]))
    assert rows["centre_1m"].median_photographed == 0.0
    assert rows["centre_1m"].recall_photographed.estimate == 0.0
    assert rows["centre_in_box"].recall_photographed.estimate == 1.0
    assert rows["centre_in_box"].median_photographed == pytest.approx(232.5 / 255)


def test_only_whole_vehicles_on_tiles_that_show_both_count(compared):
    cut = torch.stack([BOX, torch.tensor([50.0, 20.0, 64.0, 40.0])])
    row = compared([*SURE, 255], SURE[:4], boxes=cut)["centre_1m"]
    assert (row.tiles, row.photographed, row.rendered) == (4, 4, 4)


def test_other_ground_and_renders_are_not_compared(compared):
    assert compared(SURE, SURE, name="elsewhere-{}") == {}
    assert compared(SURE, SURE, real=False) == {}


def test_what_the_boxes_hold_is_told(make_scene, fleet):
    """A box half white, half blue, and one that is grey."""
    picture = torch.full((3, 64, 64), 255, dtype=torch.uint8)
    picture[:, :, :32] = torch.tensor([0, 0, 255], dtype=torch.uint8)[:, None, None]
    tile = Dataset.of_images([picture], [BOX.view(1, 4)], gsd_m=0.125, ids=["tile-0"])
    detector = judging(Brightest(), 0.5)
    yours = BaselineSet("yours", tile, real=True)
    first, second = (
        look([detector], "any", images, other_classes=False) for images in (tile, flat_images([90]))
    )
    scenes = some_scenes(make_scene, fleet, 1)
    row, _ = compare_kinds([detector], yours, first, scenes, second, seed=0)
    assert row.renders == Look(90.0, 90.0, 0.0, pytest.approx(0.0, abs=0.01), 2.5)
    assert row.photographs.dark_level == pytest.approx(0.0722 * 255)
    assert row.photographs.bright_level == pytest.approx(255.0)
    assert row.photographs.white_share == 0.5
    # CIELAB of blue is (32.3, 79.2, −107.9), and half of the box is white.
    assert row.photographs.chroma == pytest.approx((79.2**2 + 107.9**2) ** 0.5 / 2, abs=0.1)
    assert row.photographs.length_m == 2.5


def test_the_score_folder_keeps_it_without_asking_the_detector_again(tmp_path, make_scene, fleet):
    scenes, brightest = some_scenes(make_scene, fleet, 6), Brightest()
    detector, yours = judging(brightest, 0.5), photographs([255] * 6)
    stage = SceneRenderer(fleet, Flat([200] * 6, [90] * 6))
    changes = [SceneChange("T-U", Worn(1))]
    score([detector], tmp_path / "scores", scenes, changes, stage, baselines=[yours])
    # Scenes as they are, scenes in the camouflage, and photographs.
    assert brightest.images == 18
    results = Results.open(tmp_path / "scores")
    main, lenient = results.likeness
    assert (main.match, lenient.match) == ("centre_1m", "centre_in_box")
    assert results.likeness_of("brightest") is main
    assert main.median_rendered == pytest.approx(200 / 255)
    assert main.higher.estimate == 1.0
    assert main.photographs.bright_level == 255.0


@pytest.mark.slow
def test_five_tiles_condemn_few_detectors_at_the_bound_and_three_would_more(monkeypatch):
    """Recalls of 90 and 80 %; a fifth of the variance of either kind is the tile's."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    rng, shares = np.random.default_rng(2), {}
    for count in (3, FEWEST_TILES, 12):
        condemned = 0
        for _ in range(400):
            kinds = []
            for recall in (0.9, 0.8):
                tile = np.repeat(np.arange(count), rng.integers(1, 9, count))
                own = rng.normal(0, 0.2**0.5, count)[tile] + rng.normal(0, 0.8**0.5, len(tile))
                scores = stats.norm.ppf(recall) + own
                kinds.append(_Seen(scores, scores > 0, tile))
            *_, between = _recalls(*kinds, resample(count, generator=rng))
            condemned += between.low > LARGEST_DIFFERENCE
        shares[count] = condemned / 400
    assert max(shares[FEWEST_TILES], shares[12]) <= 0.05 < shares[3], shares


def test_drawn_ground_has_no_such_file(tmp_path, make_scene, fleet):
    stage = SceneRenderer(fleet, Flat([200], [90]))
    scenes, detector = some_scenes(make_scene, fleet, 1), judging(Brightest(), 0.5)
    score([detector], tmp_path / "scores", scenes, [SceneChange("T-U", Worn(1))], stage)
    assert not (tmp_path / "scores" / "likeness.json").exists()
    assert Results.open(tmp_path / "scores").likeness == []
