"""What pictures show where labelled vehicles stand: ground in the shade, and paint."""

import math

import numpy as np
import pytest
import torch

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.imagery.clearing.footprints import (
    CLEAR_COAT,
    FILM,
    SLOPES,
    sunlit,
    worn_paints,
)
from skyproof.scenes.background_index import BackgroundTile, save_tile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.places import RemovedVehicle

GSD_M = 0.125
SIDE_PX = 200
PLACES = [
    RemovedVehicle(40.0 + 60 * column, 50.0 + 90 * row, 0.3 + column, "label", 4.5, 1.8)
    for column in range(3)
    for row in range(2)
]


def inside(place):
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    x, y = (columns - place.x_px) * GSD_M, (place.y_px - rows) * GSD_M
    cosine, sine = math.cos(place.heading_rad), math.sin(place.heading_rad)
    along, across = cosine * x + sine * y, cosine * y - sine * x
    return along, (np.abs(along) < 2.25) & (np.abs(across) < 0.9)


def sets(folder, image, places, light=None):
    """The tile and the cleared tile, which only lends places and light."""
    tile = BackgroundTile(
        "a", "a.png", "test", SIDE_PX, SIDE_PX, "made", light=light, removed=tuple(places)
    )
    save_tile(folder, tile, torch.from_numpy(image))
    backgrounds = BackgroundSet(folder, GSD_M, [tile])
    return backgrounds, backgrounds


@pytest.mark.parametrize("paint", [(0.9, 0.9, 0.88), (0.5, 0.1, 0.1), (0.1, 0.11, 0.2)])
@pytest.mark.parametrize("panes", [(0.05, 0.05, 0.06), (0.4, 0.42, 0.45)])
@pytest.mark.parametrize("sky", [(0.2, 0.25, 0.35), (1.0, 1.0, 1.0)])
def test_paint_is_told_from_panes_and_from_the_light_of_the_photograph(tmp_path, paint, panes, sky):
    light = Light(white=(0.8, 0.7, 0.6), black=(0.02, 0.03, 0.05), sky=sky)
    white, black = np.array(light.white), np.array(light.black)

    def shown(colour):
        reflected = srgb_to_linear(torch.tensor(colour)).numpy() * SLOPES
        value = black + (reflected + FILM + CLEAR_COAT * np.array(sky)) * (white - black)
        return (255 * linear_to_srgb(torch.from_numpy(value)).numpy()).round()[:, None]

    image = np.full((3, SIDE_PX, SIDE_PX), 90, np.uint8)
    for place in PLACES:
        along, body = inside(place)
        image[:, body] = shown(paint)
        image[:, body & (np.abs(along - 0.8) < 0.6)] = shown(panes)
    tiles, cleared = sets(tmp_path, image, [*PLACES, RemovedVehicle(9.0, 9.0)], light)
    found = worn_paints(tiles, cleared)
    assert found.shape == (len(PLACES), 3), "a vehicle without a heading shows no paint"
    assert (found - torch.tensor(paint)).abs().max() < 0.03


def test_ground_of_one_colour_keeps_its_places_and_no_place_has_no_paint(tmp_path):
    image = np.full((3, SIDE_PX, SIDE_PX), 90, np.uint8)
    assert sunlit(torch.from_numpy(image), PLACES, GSD_M) == tuple(PLACES)
    black = torch.zeros(3, SIDE_PX, SIDE_PX, dtype=torch.uint8)
    assert sunlit(black, PLACES, GSD_M) == tuple(PLACES)
    assert sunlit(black, [], GSD_M) == ()
    assert worn_paints(*sets(tmp_path, image, [])).shape == (0, 3)


def test_places_in_the_shade_are_left_out_and_those_on_darker_asphalt_stay():
    image = np.full((3, SIDE_PX, SIDE_PX), 130, np.uint8)
    image[:, inside(PLACES[1])[1]] = 130 // 2
    image[:, inside(PLACES[2])[1]] = 105
    unknown = RemovedVehicle(9.0, 9.0)
    kept = sunlit(torch.from_numpy(image), [*PLACES, unknown], GSD_M)
    assert kept == (PLACES[0], *PLACES[2:], unknown)
