"""Vehicles in the photograph's shadows, beneath its crowns and on its roofs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import BackgroundWindow, Placement, read_scenes, write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.standing import standing

SIDE_PX = 160
GSD_M = 0.125
SIZES = {"car": (4.0, 2.0, 1.5)}


@pytest.fixture
def halves(tmp_path):
    """Ground whose right half lies in full shadow, and whose upper half crowns cover."""
    shade, cover = np.zeros((2, SIDE_PX, SIDE_PX), np.uint8)
    shade[:, SIDE_PX // 2 :] = 255
    cover[: SIDE_PX // 2] = 255
    tile = BackgroundTile("train-0", "tiles/a.png", "train", SIDE_PX, SIDE_PX, "made")
    save_tile(tmp_path, tile, torch.full((3, SIDE_PX, SIDE_PX), 120, dtype=torch.uint8))
    tile = replace(
        tile,
        shade=save_map(tmp_path, "shade", tile.id, shade),
        cover=save_map(tmp_path, "cover", tile.id, cover),
    )
    write_index(tmp_path, GSD_M, [tile])
    return BackgroundSet.open(tmp_path)


def stand(backgrounds, x_m, y_m, heading_deg=0.0, turned_deg=0.0, *, shadows=True):
    window = BackgroundWindow("train-0", SIDE_PX / 2, SIDE_PX / 2, math.radians(turned_deg))
    place = Placement("car", x_m, y_m, math.radians(heading_deg))
    (found,) = standing([place], backgrounds, window, SIZES, shadows=shadows)
    assert replace(found, shade=0.0, covered=0.0) == place
    return found.shade, found.covered


def test_a_vehicle_gets_the_shadow_and_the_crown_over_its_footprint(halves):
    assert stand(halves, -5.0, -5.0) == (0.0, 0.0)
    assert stand(halves, 5.0, -5.0) == (1.0, 0.0)
    # Across the shadow's edge; half a metre of its two metres of width beneath the crowns.
    shade, covered = stand(halves, 0.0, -0.6)
    assert shade == pytest.approx(0.5, abs=0.06)
    assert covered == pytest.approx(0.2, abs=0.01)
    # Along the picture it reaches in with a nose of a quarter.
    assert stand(halves, -5.0, -1.0, 90.0)[1] == pytest.approx(0.25, abs=0.1)
    # In a window turned to the left by a quarter the crowns are on the right.
    assert stand(halves, 0.6, 5.0, 90.0, 90.0)[1] == 0.0
    assert stand(halves, -0.6, 5.0, 90.0, 90.0)[1] == pytest.approx(0.2, abs=0.01)


def test_a_vehicle_stands_on_top_of_what_covers_half_of_its_place(halves):
    assert stand(halves, -5.0, 0.6)[1] == 0.0
    assert stand(halves, -5.0, 5.0)[1] == 0.0


def test_a_sun_from_elsewhere_casts_none_of_the_photographs_shadows(halves):
    assert stand(halves, 5.0, -0.6, shadows=False) == (0.0, pytest.approx(0.2, abs=0.01))


@pytest.mark.parametrize("sun", ["photograph", "uniform"])
def test_sampled_scenes_say_how_their_vehicles_stand(halves, sun, tmp_path):
    settings = SceneSettings(size_px=96, vehicles_minimum=3, vehicles_maximum=3, sun=sun)
    generator = torch.Generator().manual_seed(0)
    scenes = sample_scenes(settings, halves, "train", SIZES, 12, generator=generator)
    found = [placement for each in scenes for placement in each.placements]
    assert any(0 < placement.covered < 0.5 for placement in found)
    assert any(placement.shade for placement in found) == (sun == "photograph")
    write_scenes(tmp_path / "scenes.jsonl", scenes)
    assert read_scenes(tmp_path / "scenes.jsonl") == scenes
    # What the ground does not say is not written: scenes of older versions keep their bytes.
    for placement in found:
        assert placement.covered != 1.0
    text = (tmp_path / "scenes.jsonl").read_text()
    assert text.count('"covered"') == sum(placement.covered > 0 for placement in found)
