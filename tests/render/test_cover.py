"""Crowns and roofs of the photograph hide what stands beneath them, in picture and labels."""

import dataclasses

import pytest
import torch

from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from tests.render.bodies import PlainGround, scene, vehicles

SHARP = RenderSettings(blur_sigma_px=0.0, noise=0.0)
SIDE_PX = 96
MIDDLE_PX = SIDE_PX // 2


def half_covered():
    """A crown over the left half of the picture."""
    cover = torch.zeros(SIDE_PX, SIDE_PX)
    cover[:, :MIDDLE_PX] = 1.0
    return cover


def beneath(place, *covered):
    placements = [
        dataclasses.replace(placement, covered=share)
        for placement, share in zip(place.placements, covered, strict=True)
    ]
    return dataclasses.replace(place, placements=tuple(placements))


def drawn(place, batch, cover):
    ground = PlainGround(value=None, cover=cover)
    return TorchRenderer(ground, SHARP)([place], batch, masks=True)


def test_the_covered_half_of_a_vehicle_is_the_photographs():
    place = scene((0.0, 0.0, 0.0), tilt_deg=0.0)
    hidden = drawn(beneath(place, 0.4), vehicles(), half_covered())
    open_air = drawn(place, vehicles(), None)
    photograph = PlainGround(value=None).window(place.background, SIDE_PX)
    assert torch.equal(hidden.image[0, :, :, :MIDDLE_PX], photograph[:, :, :MIDDLE_PX])
    assert torch.equal(hidden.image[0, :, :, MIDDLE_PX:], open_air.image[0, :, :, MIDDLE_PX:])
    assert open_air.visible_fraction.item() == 1.0
    assert hidden.visible_fraction.item() == pytest.approx(0.5, abs=0.03)
    assert hidden.visible_px.item() == pytest.approx(open_air.visible_px.item() / 2, rel=0.05)
    assert not hidden.masks[0, :, :MIDDLE_PX].any()
    assert torch.equal(hidden.masks[0, :, MIDDLE_PX:], open_air.masks[0, :, MIDDLE_PX:])
    # People draw boxes around the whole vehicle, too.
    assert torch.equal(hidden.boxes, open_air.boxes)


def test_no_gradient_comes_from_what_is_hidden():
    place = beneath(scene((0.0, 0.0, 0.0), tilt_deg=0.0), 0.4)
    for covered, some in ((torch.ones(SIDE_PX, SIDE_PX), False), (half_covered(), True)):
        batch = vehicles()
        moved = batch.vertices.clone().requires_grad_()
        drawn(place, dataclasses.replace(batch, vertices=moved), covered).image.sum().backward()
        assert bool(moved.grad.abs().sum() > 0) == some


def test_a_vehicle_on_a_roof_is_not_hidden_by_it():
    place = scene((-3.0, 0.0, 0.0), (3.0, 0.0, 0.0), tilt_deg=0.0)
    place = beneath(place, 0.0, 0.1)
    everywhere = torch.ones(SIDE_PX, SIDE_PX)
    frames = drawn(place, vehicles(2), everywhere)
    assert frames.visible_fraction[0] == 1.0
    assert frames.visible_fraction[1] < 0.5


def test_where_no_vehicle_stands_beneath_anything_nothing_changes():
    place = scene((0.0, 0.0, 0.0))
    assert torch.equal(
        drawn(place, vehicles(), half_covered()).image, drawn(place, vehicles(), None).image
    )


def test_what_stands_beneath_stays_hidden_beside_a_vehicle_on_the_roof():
    """Their shadows and blur apart, 4 m from each other."""
    place = scene((-2.0, 0.0, 90.0), (2.0, 0.0, 90.0), tilt_deg=0.0, sun_elevation_deg=85.0)
    frames = drawn(beneath(place, 0.0, 0.4), vehicles(2), torch.ones(SIDE_PX, SIDE_PX))
    assert frames.visible_fraction.tolist() == [1.0, 0.0]
    photograph = PlainGround(value=None).window(place.background, SIDE_PX)
    beside = MIDDLE_PX + round(1.0 / 0.125)
    assert torch.equal(frames.image[0, :, :, beside:], photograph[:, :, beside:])
