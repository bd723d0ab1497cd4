"""Masks of vehicles with their shadows, against drawn pictures with a known sun."""

import math

import numpy as np
import pytest
import torch

from skyproof.imagery.clearing.vehicle_masks import (
    Shadow,
    darkness_profiles,
    estimate_shadow,
    vehicle_mask,
)
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

GSD_M = 0.125


def test_a_mask_without_shadow_is_the_grown_box():
    mask = vehicle_mask(
        (30, 40),
        torch.tensor([[10.0, 12, 20, 18]]),
        Shadow((0.0, 0.0), 0.0, 0.0, 9),
        gsd_m=GSD_M,
        margin_m=0.25,
    )
    expected = torch.zeros(30, 40, dtype=torch.bool)
    expected[10:20, 8:22] = True
    assert torch.equal(mask, expected)


def test_an_unknown_shadow_doubles_the_margin_and_the_picture_ends_the_mask():
    mask = vehicle_mask(
        (30, 40), torch.tensor([[0.0, 12, 20, 18]]), None, gsd_m=GSD_M, margin_m=0.25
    )
    expected = torch.zeros(30, 40, dtype=torch.bool)
    expected[8:22, 0:24] = True
    assert torch.equal(mask, expected)


@pytest.mark.parametrize("degrees", [0, 35, 90, 200, 300])
def test_a_mask_with_shadow_is_every_place_the_moving_box_touches(degrees):
    direction = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    mask = vehicle_mask(
        (60, 60),
        torch.tensor([[24.0, 26, 36, 32]]),
        Shadow(direction, 1.5, 0.3, 9),
        gsd_m=GSD_M,
        margin_m=0.0,
    )
    rows, columns = np.mgrid[0:60, 0:60] + 0.5
    expected = np.zeros((60, 60), dtype=bool)
    for step in np.linspace(0, 12, 1200):
        x, y = columns - step * direction[0], rows - step * direction[1]
        expected |= (x >= 24) & (x <= 36) & (y >= 26) & (y <= 32)
    assert (mask.numpy() != expected).sum() <= 2


def drawn(direction, length_px, strength=0.5):
    """Nine bright boxes on noisy ground, each with a shadow moved off in the direction."""
    picture = 120 + 6 * np.random.default_rng(0).standard_normal((240, 240))
    boxes = [
        [40.0 + 70 * i, 40.0 + 70 * j, 64 + 70 * i, 54 + 70 * j] for i in range(3) for j in range(3)
    ]
    rows, columns = np.mgrid[0:240, 0:240] + 0.5
    for left, top, right, bottom in boxes:
        for step in np.arange(0, length_px, 0.25):
            x, y = columns - step * direction[0], rows - step * direction[1]
            picture[(x > left) & (x < right) & (y > top) & (y < bottom)] = 120 * strength
    for left, top, right, bottom in boxes:
        picture[int(top) : int(bottom), int(left) : int(right)] = 220
    image = torch.from_numpy(picture.clip(0, 255).astype(np.uint8)).expand(3, -1, -1).contiguous()
    return image, torch.tensor(boxes)


@pytest.mark.parametrize("degrees", [10, 100, 190, 250])
def test_the_shadow_is_found_in_the_picture(degrees):
    direction = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    shadow = estimate_shadow([darkness_profiles(*drawn(direction, 12), gsd_m=GSD_M)])
    angle = math.acos(min(1, sum(a * b for a, b in zip(shadow.direction, direction, strict=True))))
    assert math.degrees(angle) < 15
    # Drawn 1.5 m long; taken a quarter and a soft edge longer.
    assert 1.5 <= shadow.length_m < 3.0
    assert shadow.vehicles == 9


def test_no_side_is_taken_for_a_shadow_where_there_is_none():
    shadow = estimate_shadow([darkness_profiles(*drawn((1, 0), 0), gsd_m=GSD_M)])
    assert (shadow.direction, shadow.length_m) == ((0, 0), 0)


def test_a_darkness_without_an_end_is_not_a_shadow():
    """Vehicles along dark trees."""
    picture = np.full((200, 400), 150.0)
    picture[104:] = 60
    boxes = torch.tensor([[30.0 + 60 * i, 88, 64 + 60 * i, 104] for i in range(6)])
    image = torch.from_numpy(picture.astype(np.uint8)).expand(3, -1, -1).contiguous()
    shadow = estimate_shadow([darkness_profiles(image, boxes, gsd_m=GSD_M)])
    assert shadow.length_m == 0


def test_two_vehicles_are_too_few():
    image, boxes = drawn((1, 0), 12)
    assert estimate_shadow([darkness_profiles(image, boxes[:2], gsd_m=GSD_M)]) is None


class Plain:
    """Even ground."""

    def window(self, window, size_px):
        return torch.full((3, size_px, size_px), 0.5)

    def light_of(self, window):
        return Light()

    def sensor_of(self, window):
        return Sensor()

    def cover_of(self, window, size_px):
        return None


@pytest.mark.parametrize("azimuth", [0.7, 2.5, 5.0])
def test_the_shadow_of_rendered_vehicles_falls_away_from_the_sun(azimuth):
    fleet = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))
    placements = tuple(
        Placement(
            vehicle=fleet.ids[i % 2],
            x_m=-10.0 + 10 * (i % 3),
            y_m=-6.0 + 12 * (i // 3),
            heading_rad=0.9 * i,
        )
        for i in range(6)
    )
    scene = Scene(
        id="s",
        background=BackgroundWindow("t", 150.0, 150.0, 0.0),
        camera=Camera(0.0, 0.0, GSD_M, 300),
        sun=Sun(azimuth, math.radians(35)),
        placements=placements,
        seed=1,
    )
    frames = TorchRenderer(Plain())([scene], fleet.batch([p.vehicle for p in placements]))
    image = (frames.image[0].clamp(0, 1) * 255).round().to(torch.uint8)
    shadow = estimate_shadow([darkness_profiles(image, frames.boxes, gsd_m=GSD_M)])
    # Rows run down: north is up.
    away = (-math.cos(azimuth), math.sin(azimuth))
    assert sum(a * b for a, b in zip(shadow.direction, away, strict=True)) > math.cos(
        math.radians(20)
    )
    mask = vehicle_mask((300, 300), frames.boxes, shadow, gsd_m=GSD_M, margin_m=0.4)
    changed = (image.float() - 127.5).abs().amax(0) > 12
    assert (changed & mask).sum() > 0.99 * changed.sum()
