"""Maps of drivable ground: their values, and which places have room for a vehicle."""

import math

import numpy as np
import pytest
from PIL import Image

from skyproof.scenes.background_index import save_map
from skyproof.scenes.directions import direction_values, with_room

PIXEL_M = 0.125


@pytest.mark.parametrize(
    ("heading_deg", "value"),
    [(0, 1), (0.4, 1), (90, 91), (179.4, 180), (179.6, 1), (180, 1), (-90, 91), (361, 2)],
)
def test_a_value_is_a_degree_more_than_the_heading(heading_deg, value):
    assert int(direction_values(np.array(math.radians(heading_deg)))) == value


def strip(angle_rad, width_m, side_px=240):
    """Free ground along a strip through the middle."""
    rows, columns = np.mgrid[:side_px, :side_px] + 0.5 - side_px / 2
    aside_m = PIXEL_M * np.abs(-math.sin(angle_rad) * columns - math.cos(angle_rad) * rows)
    return aside_m < width_m / 2


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135])
def test_along_a_lane_there_is_room_and_across_it_none(angle_deg):
    free = strip(math.radians(angle_deg), 3.7)
    along = np.full(free.shape, direction_values(np.array(math.radians(angle_deg))))
    kept = with_room(along, free, PIXEL_M)
    middle = len(free) // 2
    assert kept[middle, middle] == along[0, 0]
    assert (kept[kept > 0] == along[0, 0]).all()
    # Its middle keeps 1.25 m to both sides: of 3.7 m, 1.2 m are left.
    rows, columns = np.nonzero(kept[middle - 60 : middle + 60, middle - 60 : middle + 60])
    turn = math.radians(angle_deg)
    aside_m = PIXEL_M * (-math.sin(turn) * (columns - 59.5) - math.cos(turn) * (rows - 59.5))
    assert np.abs(aside_m).max() == pytest.approx(0.6, abs=0.15)
    across = np.full(free.shape, direction_values(np.array(turn + math.pi / 2)))
    assert not with_room(across, free, PIXEL_M)[middle - 40 : middle + 40].any()


def test_what_stands_in_the_way_and_the_border_take_half_a_vehicle():
    free = np.ones((160, 240), bool)
    free[70:90, 150:156] = False
    kept = with_room(np.full(free.shape, 1, np.uint8), free, PIXEL_M) > 0
    # East and west a nose, 1.4 + 1.25 m, to the obstacle and to the border; else half a width.
    nose, side = 2.65 / PIXEL_M, 1.25 / PIXEL_M
    columns = np.nonzero(kept[80])[0]
    assert columns.min() == pytest.approx(nose, abs=1.5)
    assert columns[columns < 150].max() == pytest.approx(150 - nose, abs=1.5)
    rows = np.nonzero(kept[:, 60])[0]
    assert (rows.min(), rows.max()) == pytest.approx((side, 159 - side), abs=1.5)


def test_a_map_without_places_is_not_written(tmp_path):
    assert save_map(tmp_path, "drivable", "a", np.zeros((8, 8), np.uint8)) is None
    assert list(tmp_path.iterdir()) == []
    values = np.arange(64, dtype=np.uint8).reshape(8, 8)
    assert save_map(tmp_path, "drivable", "a", values) == "drivable/a.png"
    with Image.open(tmp_path / "drivable" / "a.png") as stored:
        assert np.array_equal(np.array(stored), values)
