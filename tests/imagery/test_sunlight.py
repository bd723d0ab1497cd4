"""Sun or clouds by the shadows of rendered vehicles, where both are known."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
import torch

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.sunlight import (
    OVERCAST_SKY,
    casts_hard_shadows,
    estimate_sun,
    lights_record,
    measured_lights,
    shadow_edges,
)
from skyproof.imagery.words import light_words
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Sun
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

SCENES, SIDE_PX, GSD_M = 8, 224, 0.125
SKY = (0.2, 0.25, 0.35)


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ground")
    return write_procedural_backgrounds(folder, {"test": 8}, 240, seed=8)


@cache
def parked_fleet():
    return sample_fleet(FleetSettings(24), generator=torch.Generator().manual_seed(1))


def photographs(ground, azimuth_deg, elevation_deg, light):
    """Pictures of parked vehicles under one sun: images, and the vehicles on each."""
    fleet = parked_fleet()
    settings = SceneSettings(
        size_px=SIDE_PX, vehicles_minimum=3, vehicles_maximum=5, tilt_maximum_rad=0.0
    )
    generator = torch.Generator().manual_seed(5)
    scenes = sample_scenes(settings, ground, "test", fleet.sizes_m, SCENES, generator=generator)
    sun = Sun(math.radians(azimuth_deg), math.radians(elevation_deg))
    scenes = [dataclasses.replace(each, sun=sun) for each in scenes]
    scenes = [
        dataclasses.replace(
            each,
            placements=tuple(dataclasses.replace(one, shade=0.0) for one in each.placements),
        )
        for each in scenes
    ]
    with torch.no_grad():
        frames = TorchRenderer(ground, RenderSettings(light=light))(
            scenes, placed_vehicles(fleet, scenes)
        )
    images = (frames.image * 255).round().byte()
    return images, [[standing(fleet, one) for one in each.placements] for each in scenes]


def standing(fleet, placement):
    """A vehicle as `skyproof clear` keeps it; nose and tail are not told apart."""
    length_m, width_m, _ = fleet.sizes_m[placement.vehicle]
    return RemovedVehicle(
        SIDE_PX / 2 + placement.x_m / GSD_M,
        SIDE_PX / 2 - placement.y_m / GSD_M,
        placement.heading_rad % math.pi,
        "label",
        length_m,
        width_m,
    )


def edges(images, vehicles):
    """Those of all vehicles, whose numbers go on from picture to picture."""
    rows = []
    for number, (image, own) in enumerate(zip(images, vehicles, strict=True)):
        found = shadow_edges(image, own, range(len(own)), gsd_m=GSD_M)
        found[:, 0] += 100 * number
        rows.append(found)
    return np.concatenate(rows)


def turn_deg(sun, azimuth_deg):
    """How far a sun stands from an azimuth."""
    return abs((math.degrees(sun.azimuth_rad) - azimuth_deg + 180) % 360 - 180)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "sky_share"),
    [(40, 15, 0.2), (130, 30, 0.2), (200, 40, 0.6), (310, 58, 0.2), (100, 70, 0.2)],
)
def test_the_sun_is_that_of_the_pictures(ground, azimuth_deg, elevation_deg, sky_share):
    """Also behind thin clouds, which send more than half of the light."""
    found = edges(*photographs(ground, azimuth_deg, elevation_deg, Light(sky=(sky_share,) * 3)))
    assert casts_hard_shadows(found, blur_m=0.7 * GSD_M)
    sun = estimate_sun(found)
    assert turn_deg(sun, azimuth_deg) <= 10
    assert math.degrees(sun.elevation_rad) == pytest.approx(elevation_deg, abs=8)
    assert 0 < math.degrees(sun.azimuth_sd_rad) < 12
    assert f"shadows of {len({*found[:, 0]})} vehicles" in sun.known_from


def test_labels_that_hold_the_shadows_do_not_turn_the_sun(ground):
    """Boxes drawn around vehicle and shadow reach farther on the shadow's side."""
    images, vehicles = photographs(ground, 200, 50, Light(sky=SKY))
    shifted = [
        [
            dataclasses.replace(
                one,
                x_px=one.x_px - 0.2 * math.cos(math.radians(200)) / GSD_M,
                y_px=one.y_px + 0.2 * math.sin(math.radians(200)) / GSD_M,
                length_m=one.length_m + 0.2,
                width_m=one.width_m + 0.2,
            )
            for one in own
        ]
        for own in vehicles
    ]
    sun = estimate_sun(edges(images, shifted))
    assert turn_deg(sun, 200) <= 15


def test_under_clouds_shadows_end_softly(ground):
    found = edges(*photographs(ground, 40, 30, Light(sky=OVERCAST_SKY)))
    assert casts_hard_shadows(found, blur_m=0.7 * GSD_M) is False


def test_what_does_not_tell_sun_or_clouds(ground):
    images, vehicles = photographs(ground, 40, 40, Light(sky=SKY))
    every = edges(images, vehicles)
    assert casts_hard_shadows(every, blur_m=0.09) is True
    assert casts_hard_shadows(every, blur_m=0.3) is None, "every edge is blurred as under clouds"
    two = every[every[:, 0] < 2]
    assert casts_hard_shadows(two, blur_m=0.09) is None
    assert estimate_sun(two) is None
    plain = [torch.full_like(image, 120) for image in images]
    black = [torch.zeros_like(image) for image in images]
    unknown = [[dataclasses.replace(one, heading_rad=None) for one in own] for own in vehicles]
    for none in (edges(plain, vehicles), edges(black, vehicles), edges(images, unknown)):
        assert none.shape == (0, 4)
        assert casts_hard_shadows(none, blur_m=0.09) is None
        assert estimate_sun(none) is None


def test_shadows_to_every_side_tell_no_sun(ground):
    """A flight that turned between its photographs: hard shadows, without a common direction."""
    images, vehicles = photographs(ground, 40, 40, Light(sky=SKY))
    found = edges(images, vehicles)
    found[:, 1] += found[:, 0] // 100 * math.pi / 4
    assert casts_hard_shadows(found, blur_m=0.09)
    assert estimate_sun(found) is None


@pytest.fixture(scope="module")
def flights(ground, tmp_path_factory):
    """Writes flights of eight photographs each, and returns them with the vehicles of each.

    Of the first tile of each two vehicles are known. One flight has no vehicles but labels, and
    one shows a single colour.
    """
    folder = tmp_path_factory.mktemp("flights")
    dated = SunEstimate(1.0, 0.5, known_from="date and time")
    sunny, vehicles = photographs(ground, 200, 35, Light(sky=SKY))
    cloudy, _ = photographs(ground, 200, 35, Light(sky=OVERCAST_SKY))
    empty = [ground.pixels(tile.id)[:, :SIDE_PX, :SIDE_PX] for tile in ground.tiles("test")]
    plain = [torch.full_like(image, 120) for image in sunny]
    tiles, vehicles_of = [], {}
    pictures = {"sunny": sunny, "cloudy": cloudy, "empty": empty, "plain": plain, "dated": sunny}
    for flight, images in pictures.items():
        for number, (image, own) in enumerate(zip(images, vehicles, strict=True)):
            name = f"{flight}-{number}"
            light = Light(white=(0.5,) * 3, sun=dated if flight == "dated" else None)
            tile = BackgroundTile(
                name, f"{name}.png", "train", SIDE_PX, SIDE_PX, name, flight=flight, light=light
            )
            save_tile(folder, tile, image)
            tiles.append(tile)
            vehicles_of[name] = own[:2] if number == 0 else own
    write_index(folder, GSD_M, tiles)
    return BackgroundSet.open(folder), vehicles_of


def lights_of(flights, *names, vehicles=lambda own: own):
    backgrounds, vehicles_of = flights
    chosen = [tile for tile in backgrounds.all_tiles() if tile.flight in names]
    return measured_lights(
        backgrounds, chosen, {name: vehicles(own) for name, own in vehicles_of.items()}
    )


def test_photographs_of_a_flight_share_their_light_whatever_stands_on_each(flights):
    lights = lights_of(flights, "sunny", "cloudy", "dated")
    for flight in ("sunny", "cloudy", "dated"):
        assert len({light for name, light in lights.items() if flight in name}) == 1
    assert turn_deg(lights["sunny-0"].sun, 200) <= 10
    assert lights["sunny-0"].sky == Light().sky
    assert lights["cloudy-0"].sky == OVERCAST_SKY
    assert lights["cloudy-0"].sun is None
    assert lights["dated-0"].sun.known_from == "date and time"
    # The exposure is measured anew, on the ground beside the vehicles.
    assert lights["sunny-0"].white != (0.5,) * 3
    record = lights_record(lights)
    assert len(record["suns"]) == 2 * SCENES
    assert record["overcast"] == [f"cloudy-{number}" for number in range(SCENES)]
    told = " ".join(light_words(record))
    assert f"Sun known over {2 * SCENES} of {3 * SCENES} sources" in told
    assert f"Overcast: over {SCENES} of {3 * SCENES} sources" in told
    assert "not known" not in told


@pytest.mark.parametrize(
    ("flight", "vehicles"),
    [("sunny", lambda own: []), ("empty", list), ("plain", list)],
    ids=["no labels", "labels on empty ground", "one colour"],
)
def test_flights_that_tell_nothing_leave_the_sun_open_in_one_sentence(flights, flight, vehicles):
    lights = lights_of(flights, flight, vehicles=vehicles)
    assert {(light.sun, light.sky) for light in lights.values()} == {(None, Light().sky)}
    (told,) = light_words(lights_record(lights))
    assert told.startswith(f"Where the sun stood over {SCENES} of {SCENES} sources is not known")
    assert told.endswith("scenes will draw any sun.")


@pytest.mark.parametrize("flight", ["sunny", "cloudy"])
def test_ten_labels_of_a_flight_are_enough(flights, flight):
    _, vehicles_of = flights
    every = [one for name, own in vehicles_of.items() if flight in name for one in own][:10]
    lights = lights_of(flights, flight, vehicles=lambda own: [one for one in own if one in every])
    (light,) = {*lights.values()}
    assert (light.sky == OVERCAST_SKY) is (flight == "cloudy")
    assert light.sun is None if flight == "cloudy" else turn_deg(light.sun, 200) <= 20
