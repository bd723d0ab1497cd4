"""Both renderers put vehicle and shadow in the same place, at four times the resolution."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from skyproof.cycles.jobs import crop_jobs, crop_windows
from skyproof.cycles.settings import CyclesSettings
from skyproof.geometry.projection import project
from skyproof.render.dataset import placed_vehicles
from skyproof.render.layers import draw_bodies, draw_shadows, see_bodies
from skyproof.render.lighting import lighting, scene_lights
from skyproof.render.placed import place, windows_around
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

pytestmark = pytest.mark.blender

FINER = 4
SCENES = 50
GSD_M, SIZE_PX = 0.125 / FINER, 96 * FINER
# Samples along a side there, paths per pixel here.
SETTINGS = RenderSettings(supersampling=2)
SAMPLES = 2
# Between the sky's share of the light, which a shadow keeps, and the light beside a vehicle.
SHADED = 0.6


def random_scenes(fleet):
    draws = torch.rand(
        SCENES, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    ).tolist()
    scenes = []
    for number, (x, y, turn, tilt, camera, sun, height, vehicle) in enumerate(draws):
        scenes.append(
            Scene(
                f"s{number}",
                BackgroundWindow("tile", 0.0, 0.0, 0.0),
                Camera(math.radians(20) * tilt, 2 * math.pi * camera, GSD_M, SIZE_PX),
                Sun(2 * math.pi * sun, math.radians(25 + 45 * height)),
                (
                    Placement(
                        fleet.ids[int(vehicle * len(fleet))],
                        4 * x - 2,
                        4 * y - 2,
                        2 * math.pi * turn,
                    ),
                ),
                number,
            )
        )
    return scenes


def onto_crop(layer, window, crop):
    """What a layer in a window of its own shows of a crop's window."""
    left, top, width, height = crop
    whole = torch.zeros(3 * SIZE_PX, 3 * SIZE_PX)
    x, y = (window + SIZE_PX).tolist()
    whole[y : y + len(layer), x : x + len(layer)] = layer
    left, top = left + SIZE_PX, top + SIZE_PX
    return (whole[top : top + height, left : left + width] > 0.5).numpy()


@pytest.fixture(scope="module")
def drawn(workers):
    """Per scene what Cycles drew, and the other renderer's body and shadow on the same pixels."""
    fleet = sample_fleet(FleetSettings(count=6), generator=torch.Generator().manual_seed(5))
    scenes = random_scenes(fleet)
    vehicles = placed_vehicles(fleet, scenes)
    placed = place(scenes, vehicles)
    windows = crop_windows(placed, 8, [0] * SCENES)
    ground = torch.full((SCENES, 3, SIZE_PX, SIZE_PX), 0.2)
    jobs = crop_jobs(
        scenes,
        vehicles,
        placed,
        ground,
        windows,
        CyclesSettings(samples=SAMPLES),
        [Light()] * len(scenes),
    )
    assert len(jobs) == SCENES
    return scenes, vehicles, placed, [job.window_px for job in jobs], workers.run(jobs)


def seen_bodies(scenes, vehicles, placed):
    """What the other renderer sees of vehicles, and the light of the scenes."""
    windows = windows_around(placed.screen), windows_around(placed.shadow_screen)
    lights = scene_lights([Light()] * SCENES, scenes, placed.vertices)
    return see_bodies(placed, *windows, vehicles, SETTINGS), lights


def shadow_masks(scenes, vehicles, placed, crops, *, turned_deg=0.0, raised_deg=0.0):
    """Where the other renderer's cast shadows lie, with the sun elsewhere by so many degrees."""
    directions = [
        dataclasses.replace(
            scene.sun,
            azimuth_rad=scene.sun.azimuth_rad + math.radians(turned_deg),
            elevation_rad=scene.sun.elevation_rad + math.radians(raised_deg),
        ).direction
        for scene in scenes
    ]
    sun = placed.vertices.new_tensor(directions)
    screen, depth = project(placed.vertices, sun, GSD_M, SIZE_PX)
    moved = dataclasses.replace(placed, sun=sun, shadow_screen=screen, sun_depth=depth)
    seen, lights = seen_bodies(scenes, vehicles, moved)
    # All of the sun is lost where its rays do not reach the ground.
    layers = draw_shadows(seen, lights, SETTINGS)[..., 0]
    return [onto_crop(*each) for each in zip(layers, seen.cast.origin, crops, strict=True)]


@pytest.fixture(scope="module")
def silhouettes(drawn):
    """Per scene the body's pixels in Cycles and in the other renderer."""
    scenes, vehicles, placed, crops, results = drawn
    seen, lights = seen_bodies(scenes, vehicles, placed)
    layers = draw_bodies(seen, lighting(placed, lights, SETTINGS), vehicles, SETTINGS)[..., 3]
    theirs = [onto_crop(*each) for each in zip(layers, seen.window.origin, crops, strict=True)]
    return [(result[..., 3] > 0.5, other) for result, other in zip(results, theirs, strict=True)]


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


def centroid_and_axis(mask):
    """The middle in pixels (x, y), and the direction of the longest extent."""
    points = np.stack(mask.nonzero()[::-1]).astype(float)
    return points.mean(1), np.linalg.eigh(np.cov(points))[1][:, 1]


def test_silhouettes_are_the_same(silhouettes):
    overlaps = [overlap(*pair) for pair in silhouettes]
    # Asked for are 0.95; one path per pixel decides some pixels of the rim otherwise.
    assert min(overlaps) > 0.975


def test_places_and_headings_are_the_same(silhouettes):
    for ours, theirs in silhouettes:
        (middle, axis), (other_middle, other_axis) = (
            centroid_and_axis(ours),
            centroid_and_axis(theirs),
        )
        # Half a pixel of the image is asked for, which here has four times as many.
        assert np.abs(middle - other_middle).max() < 0.1 * FINER
        assert abs(axis @ other_axis) > math.cos(math.radians(0.5))


def test_the_sun_stands_in_the_same_place(drawn, silhouettes):
    """Cycles' shadows overlap the other renderer's more than with a sun one degree elsewhere."""
    scenes, vehicles, placed, crops, results = drawn
    ground = [~(ours | theirs) for ours, theirs in silhouettes]
    dark = [result[..., 4:].mean(-1) < SHADED for result in results]

    def overlaps(**elsewhere):
        shadows = shadow_masks(scenes, vehicles, placed, crops, **elsewhere)
        return [
            overlap(a & free, b & free) for a, b, free in zip(dark, shadows, ground, strict=True)
        ]

    same = overlaps()
    # The darkest ground under the sills belongs to no cast shadow, and few paths leave single
    # pixels wrong.
    assert min(same) > 0.9
    assert np.mean(same) > 0.96
    for elsewhere in (
        {"turned_deg": 1.0},
        {"turned_deg": -1.0},
        {"raised_deg": 1.0},
        {"raised_deg": -1.0},
    ):
        assert np.mean(overlaps(**elsewhere)) < np.mean(same) - 0.007, elsewhere
