"""Vehicles placed as in the photograph: where some were removed, and on drivable ground."""

import math
from collections import Counter
from itertools import combinations

import numpy as np
import pytest
import torch

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.scenes import placing
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.directions import direction_values
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.standing import footprint

GSD_M = 0.125
SIDE_PX = 400
SIZES = {f"car-{number}": (3.4 + 0.2 * number, 1.8, 1.5) for number in range(12)}
STOOD = [
    RemovedVehicle(100.0, 300.0, 0.4, "label", 4.0, 1.8),
    RemovedVehicle(250.5, 210.0, 1.9, "picture", 5.4, 2.0),
    RemovedVehicle(190.0, 120.25, 3.0, "label", 4.6, 1.8),
    RemovedVehicle(300.0, 330.0, 2.4, "label", 3.5, 1.7),
]


def marked(vehicles, side_px=SIDE_PX):
    """A tile's picture: red discs where vehicles stood, green ones 2 m on along both headings."""
    rows, columns = np.mgrid[:side_px, :side_px] + 0.5
    image = np.zeros((3, side_px, side_px), np.uint8)
    for vehicle in vehicles:
        for channel, reach_m in ((0, 0.0), (1, 2.0), (1, -2.0)):
            x = vehicle.x_px + reach_m / GSD_M * math.cos(vehicle.heading_rad)
            y = vehicle.y_px - reach_m / GSD_M * math.sin(vehicle.heading_rad)
            image[channel][np.hypot(columns - x, rows - y) < 4] = 255
    return torch.from_numpy(image)


def cleared(folder, vehicles=STOOD, splits=("train",), side_px=SIDE_PX):
    """One tile per split, without files but with removed vehicles."""
    tiles = [
        BackgroundTile(f"{split}-0", f"{split}.png", split, side_px, side_px, "made", removed=own)
        for split, own in zip(splits, [tuple(vehicles)] * len(splits), strict=True)
    ]
    return BackgroundSet(folder, GSD_M, tiles)


def drawn(backgrounds, count=60, seed=0, split="train", places="removed", **settings):
    settings = {"size_px": 160, "vehicles_minimum": 1, "vehicles_maximum": 3, **settings}
    return sample_scenes(
        SceneSettings(places=places, **settings),
        backgrounds,
        split,
        SIZES,
        count,
        generator=torch.Generator().manual_seed(seed),
    )


def at(picture, x_m, y_m):
    """The pixel of a window at a place of the scene."""
    side = picture.shape[1]
    column, row = side / 2 + x_m / GSD_M, side / 2 - y_m / GSD_M
    return picture[:, min(int(row), side - 1), min(int(column), side - 1)]


@pytest.fixture
def still(monkeypatch):
    """Vehicles stand exactly where they are told to."""
    monkeypatch.setattr(placing, "SHIFT_M", 0.0)
    monkeypatch.setattr(placing, "TURN_RAD", 0.0)


@pytest.mark.parametrize(("size_px", "turned"), [(160, True), (300, True), (SIDE_PX, False)])
def test_vehicles_stand_where_others_were_removed_whatever_the_windows_turn(
    tmp_path, still, size_px, turned
):
    backgrounds = cleared(tmp_path)
    save_tile(tmp_path, backgrounds.tile("train-0"), marked(STOOD))
    headings = Counter()
    for scene in drawn(backgrounds, size_px=size_px, margin_m=2.5):
        quarters = scene.background.rotation_rad / (math.pi / 2)
        assert (quarters != round(quarters)) == turned
        picture = backgrounds.window(scene.background, size_px)
        assert scene.placements
        for spot in scene.placements:
            assert at(picture, spot.x_m, spot.y_m)[0] > 0.9, "the place of a removed vehicle"
            for reach_m in (2.0, -2.0):
                x = spot.x_m + reach_m * math.cos(spot.heading_rad)
                y = spot.y_m + reach_m * math.sin(spot.heading_rad)
                assert at(picture, x, y)[1] > 0.9, "its heading, one way or the other"
            assert 0 <= spot.heading_rad < 2 * math.pi
            headings[math.floor(spot.heading_rad / math.pi)] += 1
    assert min(headings[0], headings[1]) > 0.3 * sum(headings.values())


def test_vehicles_are_a_little_off_and_either_way_round(tmp_path):
    # One vehicle, in the middle of a tile that has the window's own size.
    stood = RemovedVehicle(48.0, 48.0, 0.7, "label", 4.4, 1.8)
    backgrounds = cleared(tmp_path, [stood], side_px=96)
    off, turns, ways = [], [], Counter()
    for scene in drawn(backgrounds, 800, size_px=96, vehicles_maximum=1):
        (spot,) = scene.placements
        off += [spot.x_m, spot.y_m]
        turn = spot.heading_rad + scene.background.rotation_rad - 0.7
        ways[round(turn / math.pi) % 2] += 1
        turns.append(math.degrees(turn - math.pi * round(turn / math.pi)))
    assert np.std(off) == pytest.approx(0.3, rel=0.08)
    assert abs(np.mean(off)) < 0.03
    assert np.std(turns) == pytest.approx(3, rel=0.08)
    assert min(ways.values()) > 340


def test_vehicles_are_about_as_long_as_those_that_stood_there(tmp_path, still):
    backgrounds = cleared(tmp_path)
    lengths = {}
    for scene in drawn(backgrounds, 150, size_px=300, vehicles_maximum=1):
        (spot,) = scene.placements
        # Which one it was: the one whose heading, seen in the window, is the nearest.
        turn = spot.heading_rad + scene.background.rotation_rad
        stood = min(STOOD, key=lambda one: abs(math.sin(turn - one.heading_rad)))
        lengths.setdefault(stood.length_m, set()).add(SIZES[spot.vehicle][0])
    # A third of twelve vehicles, 3.4 to 5.6 m in steps of 0.2 m, each equally likely.
    expected = {4.0: (3.8, 4.0, 4.2), 5.4: (5.0, 5.2, 5.4, 5.6), 4.6: (4.4, 4.6, 4.8)}
    for length_m, near in expected.items():
        assert {round(value, 1) for value in lengths[length_m]} >= {*near}
        assert len(lengths[length_m]) == 4
    assert {round(value, 1) for value in lengths[3.5]} == {3.4, 3.6, 3.8, 4.0}


def test_a_place_without_a_heading_is_left_out_and_one_without_a_length_takes_any(tmp_path):
    known = RemovedVehicle(60.0, 48.0, 0.5, "label")
    backgrounds = cleared(tmp_path, [RemovedVehicle(36.0, 48.0), known], side_px=96)
    scenes = drawn(backgrounds, 200, size_px=96, vehicles_maximum=1)
    spots = [(scene.placements[0], scene.background.rotation_rad) for scene in scenes]
    turns = [spot.heading_rad + turn - 0.5 for spot, turn in spots]
    assert np.abs(np.sin(turns)).max() < 0.3
    assert {spot.vehicle for spot, _ in spots} == set(SIZES)
    unknown = cleared(tmp_path / "other", [RemovedVehicle(48.0, 48.0)], side_px=96)
    with pytest.raises(ConfigurationError, match="knows no removed vehicles"):
        drawn(unknown, 1, size_px=96)


def test_counts_stay_between_the_limits_and_nothing_overlaps(tmp_path):
    # A row of bays 2.4 m apart: seven can be taken, never all at once by vehicles that wide.
    row = [RemovedVehicle(60.0 + 19.2 * k, 200.0, 1.57, "label", 4.4, 1.8) for k in range(14)]
    backgrounds = cleared(tmp_path, row)
    scenes = drawn(backgrounds, 150, size_px=256, vehicles_minimum=2, vehicles_maximum=7)
    counts = Counter(len(scene.placements) for scene in scenes)
    assert min(counts) == 2
    assert 5 <= max(counts) <= 7
    half_m = 256 * GSD_M / 2 - 2.0
    taken = set()
    for scene in scenes:
        spots = scene.placements
        assert max(max(abs(spot.x_m), abs(spot.y_m)) for spot in spots) <= half_m
        grounds = [footprint(spot, SIZES, 0.4) for spot in spots]
        assert not any(one.intersects(other) for one, other in combinations(grounds, 2))
        for spot in spots:
            turn = scene.background.rotation_rad
            x = math.cos(turn) * spot.x_m - math.sin(turn) * spot.y_m
            taken.add(round((scene.background.centre_x_px + x / GSD_M - 60) / 19.2))
    assert len(taken) > 10, "subsets are random"


def test_tiles_with_places_are_equally_likely(tmp_path):
    few, many = STOOD[:1], STOOD * 1
    tiles = [
        BackgroundTile("few", "f.png", "train", 400, 400, "made", removed=tuple(few)),
        BackgroundTile("many", "m.png", "train", 400, 400, "made", removed=tuple(many)),
        BackgroundTile("none", "n.png", "train", 400, 400, "made"),
    ]
    backgrounds = BackgroundSet(tmp_path, GSD_M, tiles)
    used = Counter(scene.background.tile for scene in drawn(backgrounds, 400, size_px=256))
    assert set(used) == {"few", "many"}
    assert abs(used["few"] - 200) < 50
    # Empty images show any ground.
    empty = drawn(backgrounds, 90, vehicles_minimum=0, vehicles_maximum=0)
    assert {scene.background.tile for scene in empty} == {"few", "many", "none"}


def test_same_seed_same_scenes(tmp_path):
    backgrounds = cleared(tmp_path)
    first = drawn(backgrounds, 20)
    assert first == drawn(backgrounds, 30)[:20]
    assert first != drawn(backgrounds, 20, seed=1)


def road(folder, angle_rad=0.6, width_m=1.0):
    """A tile whose only drivable ground is a strip through its middle, at an angle."""
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    east, north = columns - SIDE_PX / 2, SIDE_PX / 2 - rows
    aside_m = GSD_M * (-math.sin(angle_rad) * east + math.cos(angle_rad) * north)
    value = direction_values(np.array(angle_rad))
    directions = np.where(np.abs(aside_m) < width_m / 2, value, 0).astype(np.uint8)
    file = save_map(folder, "drivable", "train-0", directions)
    tile = BackgroundTile("train-0", "none.png", "train", SIDE_PX, SIDE_PX, "made", drivable=file)
    return BackgroundSet(folder, GSD_M, [tile])


@pytest.mark.parametrize("size_px", [160, 300])
def test_vehicles_stand_on_drivable_ground_along_it(tmp_path, still, size_px):
    backgrounds = road(tmp_path)
    along, ways = [], Counter()
    for scene in drawn(backgrounds, 80, places="drivable", size_px=size_px):
        window = scene.background
        turn = window.rotation_rad
        for spot in scene.placements:
            # From the scene to the tile's middle, both with y up.
            east = math.cos(turn) * spot.x_m - math.sin(turn) * spot.y_m
            north = math.sin(turn) * spot.x_m + math.cos(turn) * spot.y_m
            east += (window.centre_x_px - SIDE_PX / 2) * GSD_M
            north -= (window.centre_y_px - SIDE_PX / 2) * GSD_M
            assert abs(-math.sin(0.6) * east + math.cos(0.6) * north) < 0.5 + GSD_M
            assert abs(math.sin(spot.heading_rad + turn - 0.6)) < math.sin(math.radians(0.51))
            ways[math.cos(spot.heading_rad + turn - 0.6) > 0] += 1
            along.append(math.cos(0.6) * east + math.sin(0.6) * north)
    assert min(ways.values()) > 40
    assert np.std(along) > 5, "all along the road"


def test_what_has_no_places_is_one_sentence(tmp_path):
    bare = cleared(tmp_path, [])
    with pytest.raises(ConfigurationError, match=r"no removed vehicles on its train tiles; clear"):
        drawn(bare)
    with pytest.raises(ConfigurationError, match=r"no drivable ground on its train tiles; draw"):
        drawn(bare, places="drivable")
    # At the tile's corner, where no window reaches.
    corner = cleared(tmp_path, [RemovedVehicle(3.0, 3.0, 0.0, "label", 4.0, 1.8)])
    with pytest.raises(ConfigurationError, match="has removed places for 1 vehicles; give fewer"):
        drawn(corner)
    with pytest.raises(ConfigurationError, match="has removed places for 5 vehicles; give fewer"):
        drawn(cleared(tmp_path), vehicles_minimum=5, vehicles_maximum=5)


def test_a_map_that_is_none_is_one_sentence(tmp_path):
    backgrounds = road(tmp_path)
    file = tmp_path / "drivable" / "train-0.png"
    save_map(tmp_path, "drivable", "train-0", np.full((SIDE_PX, SIDE_PX), 200, np.uint8))
    with pytest.raises(StoredFileError, match=r"train-0\.png holds values above 180"):
        drawn(BackgroundSet(tmp_path, GSD_M, backgrounds.tiles("train")), places="drivable")
    save_map(tmp_path, "drivable", "train-0", np.full((SIDE_PX, 9), 1, np.uint8))
    with pytest.raises(StoredFileError, match=r"train-0\.png has 9 x 400 px"):
        drawn(BackgroundSet(tmp_path, GSD_M, backgrounds.tiles("train")), places="drivable")
    file.unlink()
    with pytest.raises(StoredFileError, match=r"train-0\.png is missing"):
        drawn(BackgroundSet(tmp_path, GSD_M, backgrounds.tiles("train")), places="drivable")


def test_rows_of_parked_vehicles_are_of_uniform_places_alone():
    with pytest.raises(ConfigurationError, match=r"parked_share 0\.5 is a share of uniform places"):
        SceneSettings(places="removed", parked_share=0.5)
    assert SceneSettings(places="uniform", parked_share=0.5).parked_share == 0.5
