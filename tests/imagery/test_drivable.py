"""The rule for drivable ground: streets on drawn pictures, without labels and with them."""

import math

import numpy as np
import pytest
import torch

from skyproof.imagery.drivable import drivable_directions
from skyproof.scenes.places import RemovedVehicle

GSD_M = 0.125
SIDE_PX = 320
GRASS, ASPHALT, SOIL = (80, 110, 60), (120, 120, 122), (170, 125, 90)


def street(angle_rad=0.0, ground=GRASS, surface=ASPHALT, width_m=7.0, roof=False):
    """A street with a dashed line at an angle through the middle, on rough ground."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5 - SIDE_PX / 2
    along_m = GSD_M * (math.cos(angle_rad) * columns - math.sin(angle_rad) * rows)
    aside_m = GSD_M * (-math.sin(angle_rad) * columns - math.cos(angle_rad) * rows)
    image = np.empty((3, SIDE_PX, SIDE_PX))
    image[:] = np.array(ground)[:, None, None] + rng.normal(0, 25, (SIDE_PX, SIDE_PX))
    image[:, np.abs(aside_m) < width_m / 2] = np.array(surface)[:, None]
    image[:, (np.abs(aside_m) < 0.1) & (np.mod(along_m, 6) < 3)] = 230
    if roof:
        image[:, 8:60, 8:60] = np.array(surface)[:, None, None]
    image += rng.normal(0, 2, image.shape)
    return torch.from_numpy(np.clip(image, 0, 255).astype(np.uint8)), along_m, aside_m


@pytest.mark.parametrize("angle_deg", [0, 35, 90, 145])
def test_a_street_is_drivable_along_it_and_grass_is_not(angle_deg):
    angle_rad = math.radians(angle_deg)
    image, along_m, aside_m = street(angle_rad)
    directions = drivable_directions(image, GSD_M)
    drivable = directions > 0
    assert not drivable[np.abs(aside_m) > 3.0].any(), "half a vehicle off the kerb"
    inner = (np.abs(aside_m) < 1.8) & (np.abs(along_m) < 14)
    assert drivable[inner].mean() > 0.95, "the painted line is part of it"
    headings = np.radians(directions[drivable].astype(float) - 1)
    assert np.degrees(np.abs(np.arcsin(np.sin(headings - angle_rad)))).max() < 12


def test_a_lane_narrower_than_a_vehicle_is_not_drivable():
    image, _, _ = street(width_m=1.8)
    assert not drivable_directions(image, GSD_M).any()


def test_without_labels_soil_is_not_drivable_and_a_long_grey_roof_is():
    assert not drivable_directions(street(surface=SOIL)[0], GSD_M).any()
    image, _, _ = street(angle_rad=0.3)
    image[:, 8:70, :100] = torch.tensor(ASPHALT)[:, None, None]
    assert drivable_directions(image, GSD_M)[24:54, 30:60].any()


def test_ground_whose_edges_disagree_takes_the_heading_of_a_vehicle_nearby_or_none():
    rng = np.random.default_rng(0)
    square = torch.from_numpy(rng.normal(120, 2, (3, SIDE_PX, SIDE_PX)).astype(np.uint8))
    assert not drivable_directions(square, GSD_M).any()
    heading_rad = math.radians(37)
    stood = [
        RemovedVehicle(80.0, 160.0, heading_rad, "label", 4.5, 1.8),
        RemovedVehicle(240.0, 160.0, None),
    ]
    boxes = torch.tensor([[62.0, 148, 98, 172], [222, 148, 258, 172]])
    directions = drivable_directions(square, GSD_M, boxes, stood)
    rows, columns = np.nonzero(directions)
    away_m = GSD_M * np.hypot(columns + 0.5 - 80, rows + 0.5 - 160)
    assert 5.5 < away_m.max() < 6.5
    assert set(directions[rows, columns].tolist()) == {38}


@pytest.mark.parametrize("surface", [ASPHALT, SOIL])
def test_with_labels_it_is_what_labelled_vehicles_stand_on(surface):
    image, _, aside_m = street(0.0, surface=surface, roof=True)
    # A vehicle of 4.5 x 1.8 m in the middle of the street.
    middle = SIDE_PX // 2
    vehicle = [middle - 18.0, middle - 7.0, middle + 18.0, middle + 7.0]
    image[:, middle - 7 : middle + 7, middle - 18 : middle + 18] = 20
    drivable = drivable_directions(image, GSD_M, torch.tensor([vehicle])) > 0
    assert drivable[middle + 14, 60:260].mean() > 0.5
    assert not drivable[:60, :60].any(), "nobody stood on the roof"
    assert not drivable[np.abs(aside_m) > 3.0].any()
    assert not drivable[middle - 7 : middle + 7, middle - 18 : middle + 18].any(), "taken"


def test_on_a_labelled_tile_without_vehicles_nothing_is_drivable():
    image, _, _ = street()
    assert not drivable_directions(image, GSD_M, torch.zeros(0, 4)).any()


@pytest.mark.parametrize("side_px", [1, 7, 33])
def test_tiny_tiles_have_no_drivable_ground(side_px):
    image = torch.full((3, side_px, side_px), 120, dtype=torch.uint8)
    directions = drivable_directions(image, GSD_M)
    assert directions.shape == (side_px, side_px)
    assert not directions.any()
