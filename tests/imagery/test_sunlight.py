"""Sun and sky measured from the shadows of rendered vehicles, where both are known."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
import torch

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.sunlight import (
    OVERCAST_SKY,
    Footprints,
    casts_no_shadow,
    estimate_sun,
    lights_record,
    measured_lights,
    shadow_light,
    with_sky,
)
from skyproof.imagery.clearing.vehicle_masks import darkness_profiles
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
    return write_procedural_backgrounds(folder, {"test": 8}, 240, seed=3)


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


def profiles(images, vehicles):
    footprints = [Footprints.of(own, GSD_M) for own in vehicles]
    return [
        darkness_profiles(image, own.boxes, own.headings_rad, gsd_m=GSD_M)
        for image, own in zip(images, footprints, strict=True)
    ]


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(40, 20), (200, 40), (310, 58)])
def test_sun_and_sky_are_those_of_the_pictures(ground, azimuth_deg, elevation_deg):
    light = Light(sky=SKY)
    images, vehicles = photographs(ground, azimuth_deg, elevation_deg, light)
    sun = estimate_sun(profiles(images, vehicles))
    assert sun is not None
    # The drawn ground holds shadows under another sun, which pull a little.
    turn = (math.degrees(sun.azimuth_rad) - azimuth_deg + 180) % 360 - 180
    assert abs(turn) < 15
    assert 0 < math.degrees(sun.azimuth_sd_rad) < 20
    assert math.degrees(sun.elevation_rad) == pytest.approx(elevation_deg, abs=7)
    ratios = [
        shadow_light(image, Footprints.of(own, GSD_M), sun, light, gsd_m=GSD_M)
        for image, own in zip(images, vehicles, strict=True)
    ]
    measured = with_sky(dataclasses.replace(Light(), sun=sun), ratios)
    assert measured.sky == pytest.approx(SKY, abs=0.06)
    # Bluer than the sun.
    assert measured.sky[2] > measured.sky[0]


def test_pictures_without_shadows_tell_no_sun(ground):
    images, vehicles = photographs(ground, 40, 30, Light(sky=(1.0, 1.0, 1.0)))
    none_cast = [torch.full_like(image, 120) for image in images]
    assert estimate_sun(profiles(none_cast, vehicles)) is None
    assert estimate_sun([]) is None
    two = [profiles(images, vehicles)[0][:2]]
    assert estimate_sun(two) is None


def test_vehicles_of_which_too_little_is_known_are_not_used():
    known = RemovedVehicle(50.0, 40.0, 0.3, "label", 4.0, 2.0)
    unknown = RemovedVehicle(50.0, 40.0)
    footprints = Footprints.of([unknown, known], GSD_M)
    assert footprints.headings_rad == (0.3,)
    assert footprints.boxes.tolist() == [[34.0, 32.0, 66.0, 48.0]]
    assert len(Footprints.of([unknown], GSD_M).boxes) == 0


def test_under_a_high_sun_the_sky_stays_the_usual_one():
    high = Light(sun=SunEstimate(0.0, math.radians(62)))
    low = Light(sun=SunEstimate(0.0, math.radians(40)))
    ratios = [torch.full((5, 3), 0.6 * 0.68)]
    assert with_sky(high, ratios) == high
    assert with_sky(low, ratios).sky == pytest.approx((0.6, 0.6, 0.6), abs=0.01)
    assert with_sky(low, [torch.full((2, 3), 0.6)]) == low
    # 56 degrees by shadows may be 62.
    unsure = Light(sun=SunEstimate(0.0, math.radians(56), elevation_sd_rad=math.radians(3)))
    assert with_sky(unsure, ratios) == unsure
    surer = Light(sun=SunEstimate(0.0, math.radians(53), elevation_sd_rad=math.radians(3)))
    assert with_sky(surer, ratios).sky == pytest.approx((0.6, 0.6, 0.6), abs=0.01)


def test_vehicles_without_a_dark_side_tell_an_overcast_sky(ground):
    for elevation_deg in (30, 75):
        images, vehicles = photographs(ground, 40, elevation_deg, Light(sky=SKY))
        assert not casts_no_shadow(profiles(images, vehicles))
    without = [torch.full_like(image, 120) for image in images]
    shown = profiles(without, vehicles)
    assert casts_no_shadow(shown)
    assert not casts_no_shadow([shown[0][:2]]), "two vehicles say nothing"


def several_sources(ground, folder, sunny, *, overcast):
    """Writes photographs of several sources; of "few" but two vehicles.

    Returns what measures the lights of some of these sources.
    """
    tiles, vehicles_of = [], {}
    images, vehicles = photographs(ground, 200, 35, Light(sky=SKY))
    plain = [torch.full_like(image, 120) for image in images]
    for source in (*sunny, *overcast):
        for number, own in enumerate(vehicles[: 1 if source == "few" else None]):
            name = f"{source}-{number}"
            # Where it stood behind the clouds says nothing of the others' sun.
            light = (
                Light(sun=SunEstimate(1.0, 0.5)) if source == "a" and source in overcast else None
            )
            tile = BackgroundTile(
                name, f"{name}.png", "train", SIDE_PX, SIDE_PX, source, light=light
            )
            save_tile(folder, tile, (plain if source in overcast else images)[number])
            tiles.append(tile)
            vehicles_of[name] = own[:2] if source == "few" else own
    write_index(folder, 0.125, tiles)

    def lights_of(*sources):
        chosen = [tile for tile in tiles if tile.source in sources]
        return measured_lights(BackgroundSet.open(folder), chosen, vehicles_of)

    return lights_of


def test_suns_are_shared_where_shadows_are_unclear_and_not_where_there_are_none(ground, tmp_path):
    """Of five photographs one shows two vehicles alone, and one vehicles without any shadow."""
    lights_of = several_sources(ground, tmp_path, ("a", "b", "c", "few"), overcast=("overcast",))
    lights = lights_of("a", "b", "c", "few", "overcast")
    own = lights["a"].sun
    assert "shadows of" in own.known_from
    shared = lights["few"].sun
    assert shared.known_from == "other photographs of the set"
    assert shared.azimuth_rad == own.azimuth_rad
    assert lights["overcast"].sky == OVERCAST_SKY
    assert lights["overcast"].sun is None
    assert lights["few"].sky != OVERCAST_SKY
    assert lights_of("a", "b", "few")["few"].sun is None, "two others are too few"
    record = lights_record(lights)
    assert {*record["suns"]} == {"a", "b", "c", "few"}
    assert record["overcast"] == ["overcast"]
    assert record["photographs"] == 5


def test_a_flight_under_clouds_is_overcast_where_too_few_vehicles_stand_to_tell(ground, tmp_path):
    lights_of = several_sources(ground, tmp_path, ("one", "two"), overcast=("a", "b", "c", "few"))

    def sky_of_few(*others):
        return lights_of("few", *others)["few"].sky

    assert sky_of_few("a", "b", "c") == OVERCAST_SKY
    assert sky_of_few("a", "b") != OVERCAST_SKY, "two others are too few"
    assert sky_of_few("a", "b", "c", "one") == OVERCAST_SKY, "a sun against three may be feigned"
    assert sky_of_few("a", "b", "c", "one", "two") != OVERCAST_SKY
    assert lights_of("a", "b", "c", "few", "one")["one"].sun is not None


def test_each_source_has_its_own_sun_and_what_is_known_stays(ground, tmp_path):
    known = SunEstimate(1.0, 0.5, known_from="date and time")
    suns = {"west.tif": 30, "east.tif": 250, "dated.tif": 30}
    tiles, vehicles_of = [], {}
    for source, azimuth_deg in suns.items():
        images, vehicles = photographs(ground, azimuth_deg, 25, Light())
        for number, (image, own) in enumerate(zip(images, vehicles, strict=True)):
            light = Light(white=(0.8, 0.8, 0.8), sun=known if source == "dated.tif" else None)
            tile = BackgroundTile(
                id=f"{source}-{number}",
                file=f"{source}-{number}.png",
                split="train",
                width_px=SIDE_PX,
                height_px=SIDE_PX,
                source=source,
                light=light,
            )
            save_tile(tmp_path, tile, image)
            tiles.append(tile)
            vehicles_of[tile.id] = own
    write_index(tmp_path, 0.125, tiles)
    lights = measured_lights(BackgroundSet.open(tmp_path), tiles, vehicles_of)
    true = np.mean([tile.light.white for tile in ground.tiles("test")])
    for source, azimuth_deg in suns.items():
        light = lights[source]
        # The exposure is measured anew, on the ground beside the vehicles.
        assert np.mean(light.white) == pytest.approx(true, rel=0.3)
        if source == "dated.tif":
            assert light.sun == known
        else:
            turn = (math.degrees(light.sun.azimuth_rad) - azimuth_deg + 180) % 360 - 180
            assert abs(turn) < 15
            assert "shadows of" in light.sun.known_from
