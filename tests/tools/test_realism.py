"""What tools/realism.py measures, on windows and images that the tests draw themselves."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from realism import Realism
from realism_classifier import Windows, occlusion
from realism_crops import CROP_M, Crop, read_crops, side_px
from realism_folds import Fold, auc_interval, drift_of_sources, place_folds, spots, strip_folds
from realism_images import in_tile
from realism_sheets import pairs
from realism_statistics import statistics
from realism_trials import Effort, Trial, null_of_real, tell
from sklearn.metrics import roc_auc_score

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet, BackgroundTile, save_tile, write_index
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun, write_scenes

# Coarser than imagery that the tool is made for, so that the tests are quick.
GSD_M = 0.25
SIDE, ROOM = side_px(GSD_M)
WHOLE = SIDE + 2 * ROOM


def area(scores, positive, folds=None, clusters=None):
    positive = np.asarray(positive)
    return auc_interval(
        np.atleast_2d(np.asarray(scores, dtype=float)),
        positive,
        np.zeros(len(positive), dtype=int) if folds is None else np.asarray(folds),
        np.arange(len(positive)) if clusters is None else np.asarray(clusters),
        generator=np.random.default_rng(0),
    )


def test_the_area_is_that_of_scikit_learn_with_an_interval_around_it():
    draws = np.random.default_rng(1)
    positive = draws.random(80) < 0.4
    scores = np.round(draws.normal(positive * 1.0, 1.0), 1)  # with ties
    found = area(scores, positive)
    assert found.estimate == pytest.approx(roc_auc_score(positive, scores))
    assert 0.4 < found.low < found.estimate < found.high <= 1


def test_the_area_is_the_mean_over_repeats():
    positive = [False, False, True, True]
    assert area([[1, 2, 3, 4], [4, 3, 2, 1]], positive).estimate == 0.5


def test_only_windows_of_one_fold_are_compared():
    # The second fold's network gives higher values to all; within the folds every pair is right.
    positive = [False, True, False, True, True]
    assert area([0, 1, 10, 11, -5], positive, folds=[0, 0, 1, 1, -1]).estimate == 1
    assert area([0, 1, 10, 11, -5], positive).estimate < 1
    assert math.isnan(area([0, 1], [False, True], folds=[0, 1]).estimate)


def test_a_spot_of_many_windows_weighs_as_one():
    positive = [False, False] + [True] * 10
    scores = [1, 2, 0] + [3] * 9
    assert area(scores, positive).estimate == pytest.approx(0.9)
    clusters = [0, 1, 2] + [3] * 9
    assert area(scores, positive, clusters=clusters).estimate == pytest.approx(0.5)


def crop(x_m, y_m, *, rendered=False, vehicle="", place="Town", pixels=None):
    if pixels is None:
        pixels = torch.full((3, WHOLE, WHOLE), 100, dtype=torch.uint8)
    middle = WHOLE / 2
    box = (middle - 9.0, middle - 4.0, middle + 9.0, middle + 4.0)
    return Crop(pixels, box, rendered, place, place, (x_m, y_m), vehicle)


def scattered(count, *, rendered, fleet=1, place="Town", seed=0):
    places = np.random.default_rng(seed).uniform((0, 0), (40, 90), (count, 2))
    names = [f"car-{number % fleet}" if rendered else "" for number in range(count)]
    return [
        crop(x, y, rendered=rendered, vehicle=name, place=place)
        for (x, y), name in zip(places, names, strict=True)
    ]


def test_strips_share_neither_ground_nor_vehicles_of_the_fleet():
    crops = scattered(120, rendered=False) + scattered(300, rendered=True, fleet=40, seed=1)
    along = np.array([one.position_m[1] for one in crops])
    folds = strip_folds(crops, 3, gap_m=7)
    real = np.array([not one.rendered for one in crops])
    # Every real window is tested once; a rendered one at most once, with its vehicle's turn.
    tested = sum(fold.test.astype(int) for fold in folds)
    assert (tested[real] == 1).all()
    assert tested.max() == 1
    assert tested[~real].sum() > 60
    for fold in folds:
        assert (fold.train & real).sum() > 30
        distance = np.abs(along[fold.train][:, None] - along[fold.test][None])
        assert distance.min() >= 7
        vehicles = [{crops[index].vehicle for index in np.flatnonzero(part & ~real)}
                    for part in (fold.train, fold.test)]  # fmt: skip
        assert not vehicles[0] & vehicles[1]


def test_places_are_tested_one_by_one():
    towns = [
        one
        for place in ("Town", "Village")
        for rendered in (False, True)
        for one in scattered(20, rendered=rendered, fleet=10, place=place)
    ]
    assert place_folds(towns[:40]) == []
    for fold, place in zip(place_folds(towns), ("Town", "Village"), strict=True):
        assert {towns[index].place for index in np.flatnonzero(fold.test)} == {place}
        assert place not in {towns[index].place for index in np.flatnonzero(fold.train)}
        assert fold.train.sum() > 20


def test_photographs_are_found_shifted_or_of_other_ground():
    draws = np.random.default_rng(0)
    ground = draws.normal(size=(300, 320)).repeat(2, 0).repeat(2, 1).astype(np.float32)
    views = {
        "first": ground[100:400, 100:420],
        "second": ground[88:388, 130:450] + draws.normal(0, 0.3, (300, 320)).astype(np.float32),
        "other": draws.normal(size=(300, 320)).astype(np.float32),
    }
    found = drift_of_sources("Town", views)
    # What is at (0, 0) of the second is at (30, -12) of the first.
    assert found["second"].shift_px == (30.0, -12.0)
    assert found["second"].ground == found["first"].ground == "Town"
    assert found["other"].ground == "Town/other"


def test_windows_of_one_spot_get_one_number():
    crops = [crop(0, 0), crop(0.9, 0.9), crop(4, 0), crop(0, 0, rendered=True)]
    first, second, third, fourth = spots(crops)
    assert first == second
    assert len({first, third, fourth}) == 3


def test_pairs_are_of_one_spot_where_there_is_one():
    crops = [
        crop(0, 0),
        crop(20, 0),
        crop(50, 50, rendered=True),
        crop(20.5, 0.5, rendered=True),
    ]
    chosen, matched = pairs(crops, 5, np.random.default_rng(0))
    assert chosen == [(1, 3), (0, 2)]
    assert matched == 1


def test_views_show_the_vehicle_or_all_else_however_a_window_is_turned():
    # A red vehicle, a pixel off the middle on both axes, on black ground.
    pixels = torch.zeros(3, WHOLE, WHOLE, dtype=torch.uint8)
    middle = WHOLE // 2
    pixels[0, middle - 3 : middle + 5, middle - 8 : middle + 10] = 255
    box = (middle - 8.0, middle - 3.0, middle + 10.0, middle + 5.0)
    windows = Windows([replace(crop(0, 0, pixels=pixels), box=box)], ROOM, GSD_M)
    indices = torch.zeros(50, dtype=torch.long)
    seen = {}
    for view in ("whole", "vehicle", "ground"):
        draws = torch.Generator().manual_seed(0)
        seen[view] = windows.draw(indices, view, learning=False, generator=draws)
        assert seen[view].shape == (50, 3, SIDE, SIDE)
    red = {view: ((1 + images[:, 0]) / 2 * (images[:, 0] != 0)).sum((1, 2))
           for view, images in seen.items()}  # fmt: skip
    assert red["whole"] == pytest.approx(18 * 8, rel=0.05)
    assert red["vehicle"] == pytest.approx(18 * 8, rel=0.08)
    hidden = (seen["ground"] == 0).all(1)
    # The vehicle's corners reach a little out of its disc.
    assert float(((seen["ground"][:, 0] > 0) & ~hidden).sum((1, 2)).max()) <= 8
    # Beside the disc of the vehicle there is some ground, and it is as dark as it is.
    assert float((~hidden).sum((1, 2)).min()) > 250
    # No two windows are turned and shifted alike.
    assert len({round(float(value), 3) for value in (seen["whole"] ** 2).sum((1, 2, 3))}) > 40


def drawn(count, *, planted, seed):
    """Noisy ground with a vehicle in its middle; a planted one has a dark edge of one pixel."""
    draws = np.random.default_rng(seed)
    crops = []
    for one in scattered(count, rendered=planted, fleet=count, seed=seed):
        pixels = draws.normal(110, 6, (3, WHOLE, WHOLE))
        left, top, right, bottom = (int(value) for value in one.box)
        pixels[:, top:bottom, left:right] += draws.uniform(-60, 60, (3, 1, 1))
        if planted:
            pixels[:, top, left:right] -= 70
        bytes_ = torch.from_numpy(pixels.clip(0, 255).astype(np.uint8))
        crops.append(replace(one, pixels=bytes_))
    return crops


def test_a_planted_difference_is_found_where_it_is():
    crops = drawn(120, planted=False, seed=1) + drawn(240, planted=True, seed=2)
    positive = np.array([one.rendered for one in crops])
    folds = strip_folds(crops, 2, 7)
    effort = Effort(GSD_M, folds=2, steps=50, seeds=(0,))
    areas = {}
    for view in ("vehicle", "ground"):
        told = tell(Trial(view, crops, positive, folds, view), effort)
        areas[view] = area(told.scores, positive, told.fold_of).estimate
        if view == "vehicle":
            network = told.networks[0]
    assert areas["vehicle"] > 0.9
    assert 0.3 < areas["ground"] < 0.7
    # Hiding the dark edge, four pixels above the middle, takes the evidence away.
    rendered = np.flatnonzero(positive)[:40]
    falls = occlusion(network, Windows(crops, ROOM, GSD_M), rendered, 4, 2).mean(0)
    row, _ = np.unravel_index(falls.argmax(), falls.shape)
    assert row * 2 <= SIDE / 2 - 4 < row * 2 + 4


def test_no_difference_is_not_found_and_every_seed_repeats():
    crops = drawn(140, planted=False, seed=3)
    positive = np.arange(140) % 2 == 1
    folds = strip_folds(crops, 2, 7)
    effort = Effort(GSD_M, folds=2, steps=25, seeds=(0,))
    trial = Trial("whole", crops, positive, folds)
    first, second = tell(trial, effort), tell(trial, effort)
    assert 0.35 < area(first.scores, positive, first.fold_of).estimate < 0.65
    assert np.array_equal(first.scores, second.scores)


def test_the_null_of_real_vehicles_sees_a_vehicle_that_leaks():
    # Every spot has its own colour. Where it is learnt from too, its side is known.
    draws = np.random.default_rng(5)
    crops = []
    for one in scattered(24, rendered=False):
        tint = torch.from_numpy(draws.integers(0, 255, (3, 1, 1))).to(torch.uint8)
        crops += [replace(one, pixels=tint.expand(3, WHOLE, WHOLE).clone())] * 5
    effort = Effort(GSD_M, folds=2, steps=40, seeds=(0, 1))
    row = null_of_real(crops, effort)
    assert 0.2 < row["auc"] < 0.8
    side = np.random.default_rng(0).permutation(24).repeat(5) % 2 == 1
    everything = np.ones(len(crops), dtype=bool)
    leaking = Trial("whole", crops, side, [Fold("all", everything, everything)])
    told = tell(leaking, replace(effort, seeds=(0,)))
    assert area(told.scores, side, told.fold_of).estimate > 0.9


def test_too_few_windows_are_told():
    crops = drawn(8, planted=False, seed=1) + drawn(8, planted=True, seed=2)
    positive = np.array([one.rendered for one in crops])
    trial = Trial("whole", crops, positive, strip_folds(crops, 3, 7))
    with pytest.raises(ConfigurationError, match="more images"):
        tell(trial, Effort(GSD_M, folds=3, steps=1, seeds=(0,)))


def test_statistics_are_those_of_the_pixels():
    pixels = torch.full((3, WHOLE, WHOLE), 80, dtype=torch.uint8)
    plain = crop(0, 0, pixels=pixels.clone())
    left, top, right, bottom = (int(value) for value in plain.box)
    pixels[0, top:bottom, left:right] = 200
    pixels[1:, top:bottom, left:right] = 100
    pixels[:, top, left:right] = 255
    both = statistics([plain, crop(0, 0, pixels=pixels)], GSD_M)
    assert both["middle, red - blue"].tolist() == [0, 100]
    assert both["middle, saturation (max - min)"].tolist() == [0, 100]
    assert both["box, share of pixels >= 250 (%)"][1] == pytest.approx(100 / (bottom - top))
    grey = 0.299 * 200 + 0.701 * 100
    assert both["middle - ring"] == pytest.approx([0, grey - 80])
    assert both["label, longer side (m)"] == pytest.approx([18 * GSD_M] * 2)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Two photographs as labelled tiles, and the same tiles with rendered vehicles instead.

    Vehicles stand in the left half, so that the right one is ground without any.
    """
    folder = tmp_path_factory.mktemp("world")
    size = 224
    tiles = [
        BackgroundTile(name, f"test/images/{name}.png", "test", size, size, f"{name[:5]}.png")
        for name in ("first-0", "secon-0")
    ]
    draws = np.random.default_rng(0)
    coarse = torch.from_numpy(draws.uniform(60, 160, (1, 3, 30, 30)))
    ground = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear")[0].byte()
    (folder / "tiles" / "test").mkdir(parents=True)
    with CocoWriter(folder / "tiles" / "test", gsd_m=GSD_M) as writer:
        for tile in tiles:
            image = ground.clone()
            boxes = _places(draws)
            for left, top, right, bottom in boxes:
                image[:, top:bottom, left:right] = 230
            writer.add(image, tile.id, [_label(box) for box in boxes])
    write_index(folder / "tiles", GSD_M, tiles)
    empty = [replace(tile, file=f"{tile.id}.png") for tile in tiles]
    (folder / "cleared").mkdir()
    for tile in empty:
        save_tile(folder / "cleared", tile, ground)
    write_index(folder / "cleared", GSD_M, empty)
    cleared = BackgroundSet.open(folder / "cleared")
    (folder / "rendered").mkdir()
    scenes = []
    with CocoWriter(folder / "rendered", gsd_m=GSD_M) as writer:
        for quarters in range(4):
            for tile in tiles:
                window = BackgroundWindow(tile.id, size / 2, size / 2, quarters * math.pi / 2)
                # Drawn upright, then turned as the window is.
                boxes = _places(draws)
                image = ground.clone()
                for left, top, right, bottom in boxes:
                    image[:, top:bottom, left:right] = 20
                shown = (cleared.window(window, size) * 255).round().byte()
                turned = image.rot90(-quarters, (1, 2))
                assert torch.equal(turned[:, 0], shown[:, 0])
                for _ in range(quarters):
                    boxes = [(size - b, l, size - t, r) for l, t, r, b in boxes]  # noqa: E741
                name = f"{tile.id}-{quarters}"
                labels = [_label(box, f"car-{i % 10}") for i, box in enumerate(boxes)]
                writer.add(turned, name, labels)
                placements = tuple(Placement("car-0", 0.0, 0.0, 0.0) for _ in boxes)
                camera = Camera(0.0, 0.0, GSD_M, size)
                scenes.append(Scene(name, window, camera, Sun(0.0, 1.0), placements, 0))
    write_scenes(folder / "rendered" / "scenes.jsonl", scenes)
    return folder


def _places(draws):
    grid = [(x, y) for x in (25, 60, 95) for y in range(25, 205, 35)]
    shifted = [(x + int(draws.integers(0, 6)), y + int(draws.integers(0, 6))) for x, y in grid]
    return [(x - 9, y - 4, x + 9, y + 4) for x, y in shifted]


def _label(box, vehicle=None):
    left, top, right, bottom = map(float, box)
    return Annotation((left, top, right, bottom), ((left + right) / 2, (top + bottom) / 2),
                      vehicle=vehicle)  # fmt: skip


@pytest.mark.parametrize("turn", [0, 1, 2, 3, 0.3])
def test_points_of_a_window_are_found_in_its_tile(tmp_path, turn):
    # Red tells the column and green the row of the tile.
    size = 120
    tile = BackgroundTile("a", "a.png", "test", size, size, "a.png")
    steps = torch.arange(size, dtype=torch.uint8)
    image = torch.stack([steps.expand(size, size), steps[:, None].expand(size, size)] * 2)[:3]
    save_tile(tmp_path, tile, image)
    write_index(tmp_path, GSD_M, [tile])
    window = BackgroundWindow("a", 70.0, 50.0, turn * math.pi / 2)
    shown = BackgroundSet.open(tmp_path).window(window, 40)
    for column, row in ((3, 5), (30, 11), (20, 39)):
        (found,) = in_tile(window, np.array([[column + 0.5, row + 0.5]]), 40)
        assert shown[:2, row, column].numpy() * 255 + 0.5 == pytest.approx(found, abs=0.02)


def cut(world, most=1000):
    draws = np.random.default_rng(0)
    real = [f"Town={world / 'tiles' / 'test'}@{GSD_M}"]
    rendered = [f"Town={world / 'rendered'}"]
    return read_crops(real, rendered, [world / "tiles"], ["vehicle"], most=most, generator=draws)


def test_windows_are_cut_alike_and_ground_without_vehicles_is_the_same(world):
    crops, gsd_m = cut(world)
    assert gsd_m == GSD_M
    kinds = [[one for one in crops.vehicles if one.rendered == wanted] for wanted in (False, True)]
    assert len(kinds[0]) == 36
    assert len(kinds[1]) == 144
    assert {one.vehicle for one in kinds[1]} == {f"car-{number}" for number in range(10)}
    for one in crops.vehicles:
        left, top, right, bottom = (round(value) for value in one.box)
        # Whichever way the window was turned, the tile's orientation is shown.
        assert (right - left, bottom - top) == (18, 8)
        value = 20 if one.rendered else 230
        assert (one.pixels[:, top:bottom, left:right] == value).all()
        assert one.ground == "Town"
        assert 5.99 <= one.position_m[0] <= 26.01
    # Real and rendered vehicles stand in the same rows of the tile.
    rows = [np.unique([round((one.position_m[1] - 6) / 8.75) for one in kind]) for kind in kinds]
    assert rows[0].tolist() == rows[1].tolist()
    assert len(crops.empty) >= 20
    for real, rendered in zip(crops.empty[::2], crops.empty[1::2], strict=True):
        assert (real.rendered, rendered.rendered) == (False, True)
        assert np.hypot(*np.subtract(real.position_m, rendered.position_m)) < 0.2
        assert not ((real.pixels == 230) | (real.pixels == 20)).all(0).any()
        same = any(
            torch.equal(real.pixels[:, 2:-2, 2:-2],
                        rendered.pixels[:, 2 + y : WHOLE - 2 + y, 2 + x : WHOLE - 2 + x])
            for x in (-1, 0, 1) for y in (-1, 0, 1)
        )  # fmt: skip
        assert same


def test_vehicles_near_the_border_are_left_out_and_counted(world):
    crops, _ = cut(world)
    assert crops.left_out == 0
    assert min(one.position_m[0] for one in crops.vehicles) >= CROP_M / 2


def test_the_tool_tells_and_writes_what_it_found(world, capsys):
    tool = Realism(
        real=(f"Town={world / 'tiles' / 'test'}@{GSD_M}",),
        rendered=(f"Town={world / 'rendered'}",),
        backgrounds=(world / "tiles",),
        out=world / "out",
        folds=2,
        seeds=1,
        steps=20,
    )
    tool.run()
    record = json.loads((world / "out" / "realism.json").read_text())
    rows = {row["name"]: row for row in record["rows"]}
    assert list(rows) == [
        "whole",
        "vehicle",
        "ground",
        "null: ground without vehicles",
        "null: real from other real",
    ]
    # White against black.
    assert rows["vehicle"]["auc"] > 0.9
    assert record["statistics"]["middle, p50"]["auc"]["auc"] == 0
    assert record["windows"]["real"]["vehicles"] == 36
    for name in ("pairs.png", "told.png", "occlusion.png"):
        assert (world / "out" / name).stat().st_size > 1000
    assert "AUC of it alone" in capsys.readouterr().out


def test_an_argument_of_another_form_is_refused(world):
    draws = np.random.default_rng(0)
    with pytest.raises(ConfigurationError, match="NAME=FOLDER"):
        read_crops([], [str(world / "rendered")], [], [], most=1, generator=draws)
