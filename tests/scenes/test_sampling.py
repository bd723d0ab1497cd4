"""Scene sampling: counts, places, no overlap, camera disc, determinism."""

import hashlib
import math
from itertools import combinations

import numpy as np
import pytest
import torch

from skyproof.errors import ConfigurationError
from skyproof.scenes.background_index import BackgroundTile, save_map
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Placement, write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.standing import footprint

SIZES = {"car": (4.4, 1.8, 1.5), "van": (5.6, 2.1, 2.4), "small": (3.4, 1.6, 1.4)}


@pytest.fixture(scope="module")
def backgrounds(tmp_path_factory):
    tiles = [
        BackgroundTile(f"{split}-0", "none.png", split, 560, 600, "made")
        for split in ("train", "test")
    ]
    return BackgroundSet(tmp_path_factory.mktemp("set"), 0.125, tiles)


def _sample(backgrounds, count=300, seed=0, sizes=SIZES, **settings):
    generator = torch.Generator().manual_seed(seed)
    return sample_scenes(
        SceneSettings(**settings), backgrounds, "test", sizes, count, generator=generator
    )


def _points(placement, step=0.1):
    """Ground points densely covering a vehicle, `[n, 2]` m."""
    length, width, _ = SIZES[placement.vehicle]
    u = torch.arange(-length / 2, length / 2 + 1e-9, step)
    v = torch.arange(-width / 2, width / 2 + 1e-9, step)
    u, v = torch.meshgrid(u, v, indexing="ij")
    c, s = math.cos(placement.heading_rad), math.sin(placement.heading_rad)
    return torch.stack([placement.x_m + c * u - s * v, placement.y_m + s * u + c * v], -1).reshape(
        -1, 2
    )


def test_vehicles_keep_their_distance(backgrounds):
    scenes = _sample(backgrounds, 120, size_px=192, vehicles_minimum=4)
    pairs = 0
    for scene in scenes:
        points = [_points(placement) for placement in scene.placements]
        for i in range(len(points)):
            for j in range(i):
                pairs += 1
                # Points every 0.1 m: the nearest two are at most 0.15 m further apart than the
                # outlines.
                assert float(torch.cdist(points[i], points[j]).min()) > 0.4 - 1e-4
    assert pairs > 600


def test_overlaps_of_footprints_agree_with_points():
    generator = torch.Generator().manual_seed(1)
    disagreements = found = 0
    for _ in range(400):
        draws = torch.rand(6, generator=generator).tolist()
        first = (0.0, 0.0, draws[0] * 7, 4.4, 1.8)
        second = ((draws[1] - 0.5) * 9, (draws[2] - 0.5) * 9, draws[3] * 7, 5.0, 2.0)
        grid = torch.stack(
            torch.meshgrid(*[torch.arange(-4, 4, 0.04)] * 2, indexing="ij"), -1
        ).reshape(-1, 2)
        inside = torch.ones(len(grid), dtype=torch.bool)
        for x, y, heading, length, width in (first, second):
            d = grid - torch.tensor([x, y])
            u = d[:, 0] * math.cos(heading) + d[:, 1] * math.sin(heading)
            v = -d[:, 0] * math.sin(heading) + d[:, 1] * math.cos(heading)
            inside &= (u.abs() < length / 2) & (v.abs() < width / 2)
        found += bool(inside.any())
        one, other = (
            footprint(Placement("some", *stance), {"some": (length, width, 1.5)}, 0.0)
            for *stance, length, width in (first, second)
        )
        disagreements += one.intersects(other) != bool(inside.any())
    assert 50 < found < 350
    assert disagreements <= 4, "only slivers thinner than the point grid may differ"


def test_counts_are_uniform_and_places_fill_the_image(backgrounds):
    scenes = _sample(backgrounds, 1000)
    counts = torch.bincount(torch.tensor([len(scene.placements) for scene in scenes]), minlength=6)
    assert counts[0] == 0
    assert (counts[1:] > 150).all()
    places = torch.tensor(
        [[p.x_m, p.y_m, p.heading_rad] for scene in scenes for p in scene.placements]
    )
    assert places[:, :2].abs().max() <= 22.0
    assert places[:, :2].abs().max() > 21.5
    assert (places[:, :2].mean(0).abs() < 1).all()
    # A uniform place on [-22, 22] has a standard deviation of 44 / sqrt(12) = 12.7.
    torch.testing.assert_close(places[:, :2].std(0), torch.full((2,), 12.7), atol=0.6, rtol=0)
    assert torch.histc(places[:, 2], 8, 0, 2 * math.pi).min() > 0.08 * len(places)
    assert {p.vehicle for scene in scenes for p in scene.placements} == set(SIZES)


def test_exactly_one_and_none(backgrounds):
    assert all(
        len(s.placements) == 1
        for s in _sample(backgrounds, 50, vehicles_minimum=1, vehicles_maximum=1)
    )
    empty = _sample(backgrounds, 5, sizes={}, vehicles_minimum=0, vehicles_maximum=0)
    assert all(s.placements == () for s in empty)
    assert {
        len(s.placements) for s in _sample(backgrounds, 60, vehicles_minimum=0, vehicles_maximum=1)
    } == {0, 1}


def test_camera_is_a_uniform_point_on_the_disc(backgrounds):
    scenes = _sample(backgrounds, 2000, vehicles_maximum=1)
    radius = torch.tensor([math.sin(s.camera.tilt_rad) for s in scenes]) / math.sin(
        math.radians(20)
    )
    azimuth = torch.tensor([s.camera.azimuth_rad for s in scenes])
    assert radius.max() <= 1
    # On a uniform disc the squared radius is uniform: half of the points lie outside 0.707 of the
    # radius.
    squared = torch.histc(radius**2, 5, 0, 1) / len(scenes)
    assert (squared - 0.2).abs().max() < 0.04
    assert (torch.histc(azimuth, 4, 0, 2 * math.pi) / len(scenes) - 0.25).abs().max() < 0.04
    elevation = torch.rad2deg(torch.tensor([s.sun.elevation_rad for s in scenes]))
    assert 25 <= elevation.min() < 26
    assert 64 < elevation.max() <= 65.001


def test_same_seed_same_scenes_and_prefixes_of_longer_sets(backgrounds):
    before = torch.random.get_rng_state()
    first = _sample(backgrounds, 20)
    assert first == _sample(backgrounds, 20)
    assert first == _sample(backgrounds, 30)[:20]
    assert first != _sample(backgrounds, 20, seed=1)
    assert len({scene.seed for scene in first}) == 20
    assert len({scene.id for scene in first}) == 20
    assert all(scene.background.tile == "test-0" for scene in first)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize(
    ("settings", "sizes", "message"),
    [
        ({"size_px": 64, "vehicles_minimum": 40, "vehicles_maximum": 40}, SIZES, "No room"),
        ({}, {}, "no vehicle"),
        ({"vehicles_minimum": 3, "vehicles_maximum": 2}, SIZES, "minimum"),
        ({"size_px": 24}, SIZES, "margin"),
        ({"size_px": 570}, SIZES, "no test tile"),
    ],
)
def test_impossible_settings_raise(backgrounds, settings, sizes, message):
    with pytest.raises(ConfigurationError, match=message):
        _sample(backgrounds, 2, sizes=sizes, **settings)


def test_parked_vehicles_stand_in_rows_without_touching(backgrounds):
    settings = SceneSettings(
        size_px=192, vehicles_minimum=4, vehicles_maximum=8, parked_share=1.0, gap_m=0.4
    )
    scenes = sample_scenes(
        settings, backgrounds, "train", SIZES, 60, generator=torch.Generator().manual_seed(3)
    )
    beside = behind = 0
    for scene in scenes:
        places = scene.placements
        assert 4 <= len(places) <= 8
        assert max(max(abs(each.x_m), abs(each.y_m)) for each in places) <= settings.half_m(0.125)
        grounds = [footprint(each, SIZES, 0.0) for each in places]
        assert not any(one.intersects(other) for one, other in combinations(grounds, 2))
        axes = np.array([2 * each.heading_rad for each in places])
        # Doubled angles: nose and tail count alike.
        if np.abs(np.exp(1j * axes).mean()) < math.cos(math.radians(6)):
            continue  # no room for a row of so many: placed at random instead
        row = np.arctan2(places[-1].y_m - places[0].y_m, places[-1].x_m - places[0].x_m)
        turned = abs(math.cos(row - places[0].heading_rad))
        beside, behind = beside + (turned < 0.2), behind + (turned > 0.98)
    assert beside > 10
    assert behind > 5


def test_scenes_without_parking_are_the_same_as_ever(backgrounds):
    with_share = SceneSettings(size_px=192, parked_share=0.5)
    without = sample_scenes(
        SceneSettings(size_px=192),
        backgrounds,
        "train",
        SIZES,
        40,
        generator=torch.Generator().manual_seed(3),
    )
    mixed = sample_scenes(
        with_share, backgrounds, "train", SIZES, 40, generator=torch.Generator().manual_seed(3)
    )
    assert [scene.background for scene in mixed] == [scene.background for scene in without]
    assert [scene.sun for scene in mixed] == [scene.sun for scene in without]


def test_a_share_of_scenes_shows_ground_alone(backgrounds):
    scenes = _sample(backgrounds, 200, size_px=192, empty_share=0.4)
    empty = sum(not scene.placements for scene in scenes) / len(scenes)
    # Three standard deviations of 200 draws are 0.10.
    assert 0.3 < empty < 0.5
    # Nor does drawing a scene anew until it has shade fill those that are to be empty.
    scenes = _sample(backgrounds, 200, size_px=192, empty_share=0.4, shaded_share=1.0)
    assert 0.3 < sum(not scene.placements for scene in scenes) / len(scenes) < 0.5
    assert all(scene.placements for scene in _sample(backgrounds, 50, size_px=192))


def test_shaded_scenes_are_drawn_until_a_vehicle_is_in_shade_or_beneath_a_crown(tmp_path):
    # A third of the tile is in shade, at its edge, which windows seldom reach: about one vehicle in
    # six stands there, and of eight draws mostly one.
    shade = np.zeros((600, 600), np.uint8)
    shade[:, :210] = 255
    tile_id = "test-0"
    named = save_map(tmp_path, "shade", tile_id, shade)
    tile = BackgroundTile(tile_id, "none.png", "test", 600, 600, "made", shade=named)
    ground = BackgroundSet(tmp_path, 0.125, [tile])

    def in_shade(share):
        settings = SceneSettings(
            size_px=192, vehicles_minimum=1, vehicles_maximum=1, shaded_share=share
        )
        generator = torch.Generator().manual_seed(5)
        scenes = sample_scenes(settings, ground, "test", SIZES, 100, generator=generator)
        return sum(scene.placements[0].shade > 0.5 for scene in scenes)

    usual, half, every = map(in_shade, (0.0, 0.5, 1.0))
    assert usual < 30
    assert usual + 10 < half < every - 5
    assert every > 65


@pytest.mark.parametrize("name", ["parked_share", "shaded_share"])
def test_shares_of_uniform_places_are_refused_with_others(name):
    with pytest.raises(ConfigurationError, match=f"{name} 0.5 is a share of uniform places"):
        SceneSettings(places="drivable", **{name: 0.5})


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_refuses_an_impossible_share_of_parked_scenes(share):
    with pytest.raises(ConfigurationError, match="parked_share"):
        SceneSettings(parked_share=share)


def test_uniform_scenes_are_the_same_in_every_version(tmp_path):
    """Scene files that were made before places could be chosen, by their digest."""
    tiles = [
        BackgroundTile(f"test-{number}", "none.png", "test", width, 600, "made")
        for number, width in enumerate((560, 600, 300))
    ]
    ground = BackgroundSet(tmp_path, 0.125, tiles)
    conditions = ("clear", "haze", "low_sun")
    train = SceneSettings(
        size_px=192, vehicles_minimum=0, vehicles_maximum=7, parked_share=0.5, conditions=conditions
    )
    digest = hashlib.sha256()
    for settings in (SceneSettings(), train, SceneSettings(size_px=600)):
        generator = torch.Generator().manual_seed(7)
        scenes = sample_scenes(settings, ground, "test", SIZES, 40, generator=generator)
        write_scenes(tmp_path / "scenes.jsonl", scenes)
        digest.update((tmp_path / "scenes.jsonl").read_bytes())
    assert digest.hexdigest() == "0927aa62363d3aa2d1cbb7b27acae77e82c80010802faeefe9b2e0ced6cdcd6c"
