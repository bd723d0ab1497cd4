"""What tools/realism.py measures, on images that the tests draw and render themselves."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from realism import Realism
from realism_classifier import area, folds_of, learnt_from, occlusion, seen, spots_of, tell
from realism_pairs import Pairs, read_pairs, shift_between
from sklearn.metrics import roc_auc_score

from skyproof.errors import ConfigurationError
from skyproof.scenes.background_index import save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from tests.tools.conftest import GSD_M, RED, SIDE


@pytest.fixture(scope="module")
def renders(world):
    """Renders of one seed against those of another: there is nothing to be told."""
    return read_pairs([world / "first"], [world / "second"], world / "cleared")


def measured(pairs, views):
    spots = spots_of(pairs)
    folds = folds_of(pairs, spots, 2)
    areas = {}
    for view in views:
        scores, networks = tell(pairs, folds, view, steps=50, seeds=1)
        areas[view] = area(scores, folds, spots, generator=np.random.default_rng(0)).estimate
    return areas, networks


def test_renders_are_not_told_from_renders_of_another_seed(renders):
    areas, _ = measured(renders, ("whole", "vehicle", "ground"))
    assert all(0.3 < value < 0.7 for value in areas.values()), areas


def test_a_planted_difference_is_found_where_it_is(renders):
    # A quarter darker, rim included: wherever the vehicle may be seen, and nowhere else.
    pixels = renders.pixels.clone()
    darker = (pixels[:, 1] * 0.75).byte()
    pixels[:, 1] = torch.where(renders.vehicle[:, None], darker, pixels[:, 1])
    planted = replace(renders, pixels=pixels)
    areas, networks = measured(planted, ("vehicle",))
    assert areas["vehicle"] > 0.85
    # The ground shows nothing of it, however a window is shifted.
    indices = torch.arange(len(pixels))
    for shift in ((0, 0), (2, -2), (-2, 1)):
        views = [seen(pairs, indices, "ground", shift=shift) for pairs in (planted, renders)]
        assert torch.equal(*views)
    # A grey patch on the vehicle moves the score, whichever way, and one on the ground does not.
    falls = occlusion(networks[0], planted, indices[:40], patch_px=6, stride_px=2)[:, 1].mean(0)
    falls = np.abs(falls)
    middle = len(falls) // 2
    rim = [falls[0, 0], falls[0, -1], falls[-1, 0], falls[-1, -1]]
    assert falls[middle - 2 : middle + 3, middle - 2 : middle + 3].max() > 3 * np.max(rim)


def test_a_pair_shows_one_ground_and_hides_its_vehicles(world):
    pairs = read_pairs([world / "tiles"], [world / "second"], world / "cleared")
    assert len(pairs.pixels) > 100
    assert pairs.pixels.shape[1:] == (2, 3, SIDE, SIDE)
    red = (pairs.pixels[:, 0] == torch.tensor(RED)[:, None, None]).all(1)
    # 4.4 m x 1.8 m, all of it where the vehicle is said to be.
    assert red.sum((1, 2)).float().mean() == pytest.approx(4.4 * 1.8 / GSD_M**2, rel=0.15)
    assert not (red & ~pairs.vehicle).any()
    changed = (pairs.pixels[:, 0] != pairs.pixels[:, 1]).any(1)
    # Whichever way a scene was turned, the ground is the photograph's but for the cast shadow.
    steps = torch.arange(SIDE) - SIDE / 2 + 0.5
    far = torch.hypot(steps[:, None], steps) > 3.9 / GSD_M
    assert (changed & far).sum() < 0.03 * far.sum() * len(changed)
    assert (changed & pairs.vehicle).sum() > 0.7 * pairs.vehicle.sum()
    assert (pairs.names[:, 0] == "").all()
    # In a photograph vehicles drive off a meter or so from where they are drawn; none is elsewhere.
    assert float(pairs.hidden.float().mean()) < 0.02


def made(positions, names, grounds=None):
    count = len(positions)
    return Pairs(
        pixels=torch.zeros(count, 2, 3, SIDE, SIDE, dtype=torch.uint8),
        vehicle=torch.zeros(count, SIDE, SIDE, dtype=torch.bool),
        hidden=torch.zeros(count, SIDE, SIDE, dtype=torch.bool),
        positions_m=np.array(positions, dtype=float),
        grounds=np.zeros(count, dtype=int) if grounds is None else np.array(grounds),
        names=np.array([("", name) for name in names]),
        gsd_m=GSD_M,
    )


def test_what_is_tested_was_not_learnt_from():
    places = np.random.default_rng(0).uniform((0, 0), (30, 120), (200, 2))
    pairs = made(places, [f"car-{number % 80}" for number in range(200)])
    folds = folds_of(pairs, spots_of(pairs), 3)
    for number in range(3):
        tested = folds == number
        train = learnt_from(pairs, tested)
        assert train.sum() > 15
        apart = np.abs(places[train][:, None] - places[tested][None]).max(2)
        assert apart.min() >= 8
        assert not set(pairs.names[train, 1]) & set(pairs.names[tested, 1])
    assert np.bincount(folds).min() > 50


def test_a_parked_vehicle_is_one_spot_and_in_one_fold():
    pairs = made([(0, 0), (1, 1), (9, 0), (9.5, 0), (0, 0)], "abcde", grounds=[0, 0, 0, 0, 1])
    spots = spots_of(pairs)
    assert spots[0] == spots[1]
    assert spots[2] == spots[3]
    assert len(set(spots.tolist())) == 3
    assert folds_of(pairs, spots, 3)[[0, 2]].tolist() == folds_of(pairs, spots, 3)[[1, 3]].tolist()


def test_the_area_is_that_of_scikit_learn_within_folds_and_over_spots():
    draws = np.random.default_rng(1)
    scores = np.round(draws.normal((0.0, 1.0), 1.0, (60, 2)), 1)  # with ties
    one = np.zeros(60, dtype=int)
    found = area(scores, one, np.arange(60), generator=draws)
    truth = np.tile([0, 1], 60)
    assert found.estimate == pytest.approx(roc_auc_score(truth, scores.ravel()))
    assert 0.5 < found.low < found.estimate < found.high < 1
    # Another network's values, higher by 9, are not compared with.
    other = np.concatenate([scores, scores + 9])
    folds = np.repeat([0, 1], 60)
    same = area(other, folds, np.arange(120), generator=draws)
    assert same.estimate == pytest.approx(found.estimate)
    # A spot in sixty frames weighs as one.
    often = np.concatenate([scores[:1], np.tile([[0.0, 9.0]], (60, 1))])
    spots = np.array([0] + [1] * 60)
    once = area(often[:2], one[:2], spots[:2], generator=draws).estimate
    assert area(often, np.zeros(61, int), spots, generator=draws).estimate == pytest.approx(once)


def test_frames_of_one_flight_are_laid_over_each_other():
    draws = np.random.default_rng(0)
    ground = draws.normal(size=(300, 320)).repeat(2, 0).repeat(2, 1)
    first, second = ground[100:400, 100:420], ground[88:388, 130:450]
    # What is at (0, 0) of the second is at (30, -12) of the first.
    shift, peak = shift_between(first, second + draws.normal(0, 0.3, second.shape))
    assert shift.tolist() == [30, -12]
    assert peak > 30
    assert shift_between(first, draws.normal(size=(300, 320)))[1] < 10


def test_the_tool_writes_what_it_found(world, capsys):
    tool = Realism((world / "tiles",), (world / "second",), world / "cleared", world / "out",
                   folds=2, seeds=1, steps=25)  # fmt: skip
    tool.run()
    record = json.loads((world / "out" / "realism.json").read_text())
    blurs_px = record["blur_sigma_px"]
    assert blurs_px["real"] == pytest.approx(blurs_px["rendered"], abs=0.06)
    assert record["auc"]["vehicle"][0] > 0.9  # red, against catalogue paints
    for name in ("pairs.png", "told.png", "occlusion.png"):
        assert (world / "out" / name).stat().st_size > 1000
    assert "whole    AUC" in capsys.readouterr().out
    with pytest.raises(ConfigurationError, match="another number of --folds"):
        replace(tool, folds=60, out=world / "none").run()


def test_a_folder_that_does_not_fit_is_refused(world, tmp_path):
    cleared = BackgroundSet.open(world / "cleared")
    (tile,) = cleared.tiles("test")[:1]
    (tmp_path / "other").mkdir()
    save_tile(tmp_path / "other", replace(tile, file="a.png"), cleared.pixels(tile.id))
    write_index(tmp_path / "other", GSD_M, [replace(tile, id="elsewhere", file="a.png")])
    with pytest.raises(ConfigurationError, match="no labelled tile elsewhere"):
        read_pairs([world / "tiles"], [world / "second"], tmp_path / "other")
    shutil.copytree(world / "second", tmp_path / "second")
    path = tmp_path / "second" / "annotations.json"
    document = json.loads(path.read_text())
    del document["annotations"][0]["corners_px"]
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigurationError, match="render it again"):
        read_pairs([world / "tiles"], [tmp_path / "second"], world / "cleared")
