"""Shadows of trees and buildings: found on drawn ground, where they are known, and made up ones."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.cast_shadows import (
    find_cast_shadows,
    light_left,
    lights_record,
    shade_map,
    shaded_tiles,
)
from skyproof.imagery.clearing.sunlight import OVERCAST_SKY
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate

SIDE_PX, GSD_M = 256, 0.125
SKY = (0.25, 0.32, 0.42)
WEST = SunEstimate(math.pi, math.radians(40), known_from="date and time")
EAST = SunEstimate(0.0, math.radians(40))
LIGHT = Light(black=(0.02, 0.02, 0.02), sun=WEST)
PAVED, PLANT = (0.3, 0.28, 0.26), (0.03, 0.07, 0.02)


def scene(dark=SKY, strip=False):
    """A round crown on paved ground, its shadow to the right (the sun stands in the west).

    The shadow's colour is `dark` times the ground's. A strip has paved ground on both sides, as a
    street of dark asphalt has.
    """
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    reflected = np.empty((3, SIDE_PX, SIDE_PX))
    reflected[:] = np.array(PAVED)[:, None, None]
    shadow = np.hypot(columns - 150, rows - 128) < 44
    if strip:
        shadow = np.abs(columns - 128) < 30
    reflected[:, shadow] *= np.array(dark)[:, None]
    crown = np.hypot(columns - 110, rows - 128) < 44
    if not strip:
        reflected[:, crown] = np.array(PLANT)[:, None]
        shadow &= ~crown
    reflected *= np.random.default_rng(0).normal(1, 0.05, reflected.shape)
    shown = np.clip(reflected + 0.02, 0, 1)
    encoded = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    return torch.from_numpy((encoded * 255).round().astype(np.uint8)), shadow


def test_a_shadow_is_found_with_the_light_in_it():
    image, true = scene()
    shadows = find_cast_shadows(image, LIGHT, WEST, gsd_m=GSD_M)
    left = light_left(shadows)
    # The photograph's black is no light.
    assert left == pytest.approx(SKY, abs=0.02)
    shade = shade_map(shadows, left, (SIDE_PX, SIDE_PX), gsd_m=GSD_M)
    found = shade > 127
    assert (found & true).sum() > 0.85 * true.sum()
    assert (found & ~true).sum() < 0.05 * true.sum()
    # Soft edges.
    assert 0.02 < ((shade > 20) & (shade < 235)).mean() / found.mean() < 0.5


def no_shadow(image, sun=WEST):
    return find_cast_shadows(image, LIGHT, sun, gsd_m=GSD_M) == []


def test_what_is_dark_for_other_reasons_is_no_shadow():
    assert not no_shadow(scene()[0])
    assert no_shadow(scene(dark=(0.33, 0.33, 0.33))[0]), "dark, but not bluer: another material"
    assert no_shadow(scene(dark=(0.56, 0.64, 0.77))[0]), "hardly darker"
    assert no_shadow(scene(strip=True)[0]), "alike on both sides: a street between pavements"
    assert no_shadow(scene()[0], EAST), "a shadow falls away from the sun"
    assert no_shadow(torch.full((3, SIDE_PX, SIDE_PX), 90, dtype=torch.uint8))
    assert no_shadow(torch.full((3, 9, 9), 90, dtype=torch.uint8))


def test_areas_unlike_the_pictures_other_shadows_are_left_out():
    image, _ = scene()
    shadows = find_cast_shadows(image, LIGHT, WEST, gsd_m=GSD_M)
    size_px = (SIDE_PX, SIDE_PX)
    assert shade_map(shadows, SKY, size_px, gsd_m=GSD_M).any()
    assert not shade_map(shadows, (0.5, 0.6, 0.7), size_px, gsd_m=GSD_M).any()
    assert light_left([]) is None
    short = dataclasses.replace(shadows[0], ratios=shadows[0].ratios[:10])
    assert light_left([short]) is None, "2.5 m of edge are too little"


def test_on_drawn_ground_what_is_taken_for_shadow_is_shadow(tmp_path):
    """Where vehicles may stand; the table in docs/imagery.md has more tiles."""
    drawn = write_procedural_backgrounds(tmp_path, {"test": 24}, 320, seed=5)
    counts, errors = np.zeros(3), []
    for tile in drawn.tiles("test"):
        shadows = find_cast_shadows(drawn.pixels(tile.id), tile.light, tile.light.sun, gsd_m=GSD_M)
        left = light_left(shadows)
        true, cover = drawn.shade(tile.id), drawn.cover(tile.id)
        if left is None or true is None:
            continue
        errors.append(np.abs(np.array(left) - tile.light.sky).mean())
        found = shade_map(shadows, left, (320, 320), gsd_m=GSD_M) > 127
        ground = np.ones_like(found) if cover is None else cover.numpy() == 0
        shade = true.numpy() > 127
        counts += [(ground & part).sum() for part in (found & shade, found & ~shade, ~shade)]
    right, wrong, sunlit = counts
    assert len(errors) >= 8
    assert right / (right + wrong) > 0.85
    assert wrong / sunlit < 0.01
    assert np.median(errors) < 0.06


def photographs(folder, suns):
    """A set of one picture per source, with a crown and its shadow, and lights of these suns."""
    tiles = []
    for name, light in suns.items():
        tile = BackgroundTile(name, f"{name}.png", "train", SIDE_PX, SIDE_PX, f"{name}.tif")
        tiles.append(dataclasses.replace(tile, light=light))
        save_tile(folder, tile, scene()[0])
    write_index(folder, GSD_M, tiles)
    return BackgroundSet.open(folder)


def test_tiles_get_their_shadows_and_the_sky_they_show(tmp_path):
    overcast = dataclasses.replace(LIGHT, sky=OVERCAST_SKY)
    unknown = dataclasses.replace(LIGHT, sun=None)
    lights = {"sunny": LIGHT, "overcast": overcast, "unknown": unknown}
    backgrounds = photographs(tmp_path, lights)
    kept = shaded_tiles(backgrounds)
    sunny, others = kept[0], kept[1:]
    assert sunny.shade == "shade/sunny.png"
    assert sunny.light.sky == pytest.approx(SKY, abs=0.02)
    assert sunny.light.sun == WEST
    for tile in others:
        assert tile == backgrounds.tile(tile.id)
    assert sorted(path.name for path in tmp_path.glob("shade/*")) == ["sunny.png"]
    record = lights_record(kept, lights, kept)
    assert list(record["suns"]) == ["sunny.tif", "overcast.tif"]
    assert record["overcast"] == ["overcast.tif"]
    assert (record["photographs"], record["shaded"]) == (3, ["sunny"])


def test_maps_that_are_there_and_drawn_ground_stay(tmp_path):
    backgrounds = photographs(tmp_path, {"a": LIGHT, "b": LIGHT})
    tiles = backgrounds.tiles("train")
    own = dataclasses.replace(tiles[0], shade="mine.png")
    drawn = dataclasses.replace(tiles[1], kind="street")
    kept = shaded_tiles(BackgroundSet(tmp_path, GSD_M, [own, drawn]))
    assert kept[0].shade == "mine.png"
    assert kept[0].light.sky == pytest.approx(SKY, abs=0.02)
    assert kept[1] == drawn
