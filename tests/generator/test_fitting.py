"""Fits to vehicles whose shape, texture and parts are known."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from skyproof.generator.fits import Fit, Fits, Prototype, fitted_vehicles
from skyproof.generator.fitting import Fitter
from skyproof.generator.maps import MAP_PX, whole
from skyproof.generator.photographed import Photographed, photographed_vehicles
from skyproof.generator.settings import FitSettings
from skyproof.vehicles.vehicle import Part
from tests.generator.photographs import Photographs

pytestmark = pytest.mark.slow

SETTINGS = FitSettings(candidates=10, choose_steps=8, steps=30)
FITTED = 6


@pytest.fixture(scope="module")
def made(
    photographs: Photographs, prototypes: list[Prototype]
) -> tuple[Fitter, list[Photographed], list[Fit]]:
    vehicles, _ = photographed_vehicles(photographs.tiles, photographs.cleared)
    vehicles = vehicles[:FITTED]
    fitter = Fitter(photographs.tiles, photographs.cleared, prototypes, SETTINGS)
    return fitter, vehicles, [fitter(vehicle) for vehicle in vehicles]


def truth(photographs: Photographs, fit: Fit) -> tuple[Tensor, Tensor, Tensor, float]:
    """Vertices, texture in [0, 1], parts and heading."""
    name, heading_rad = photographs.stood[fit.id]
    vehicle = photographs.fleet.batch([name])
    return vehicle.vertices[0], vehicle.texture[0].float() / 255, vehicle.parts[0], heading_rad


def seen_texels(fit: Fit) -> Tensor:
    seen = F.interpolate(whole(fit.seen)[None, None], size=(512, 512))[0, 0]
    return seen > 0.1


def test_the_picture_of_a_fit_is_the_photograph(
    made: tuple[Fitter, list[Photographed], list[Fit]],
) -> None:
    fitter, vehicles, fits = made
    for vehicle, fit in zip(vehicles, fits, strict=True):
        photograph, rendered = fitter.pictures(vehicle, fit)
        assert rendered.shape == photograph.shape
        assert fit.misfit < 0.035
    assert sorted(fit.misfit for fit in fits)[FITTED // 2] < 0.02


def test_noses_are_found_though_labels_do_not_tell_them(
    photographs: Photographs, made: tuple[Fitter, list[Photographed], list[Fit]]
) -> None:
    _, vehicles, fits = made
    off = []
    for vehicle, fit in zip(vehicles, fits, strict=True):
        _, _, _, heading_rad = truth(photographs, fit)
        told = vehicle.scene.placements[0].heading_rad + math.pi * fit.reversed + fit.turn_rad
        off.append(abs(math.remainder(told - heading_rad, 2 * math.pi)))
    assert sum(angle < math.radians(4) for angle in off) >= FITTED - 1


def test_parts_texture_and_shape_are_those_of_the_vehicle(
    photographs: Photographs,
    prototypes: list[Prototype],
    made: tuple[Fitter, list[Photographed], list[Fit]],
) -> None:
    _, _, fits = made
    learnt = fitted_vehicles(fits, prototypes)
    overlaps, colour_errors, distances_m = [], [], []
    for row, fit in enumerate(fits):
        vertices, texture, parts, _ = truth(photographs, fit)
        seen = seen_texels(fit)
        found = prototypes[fit.prototype].parts
        for part in (Part.BODY, Part.GLASS):
            own, other = (parts == part) & seen, (found == part) & seen
            overlaps.append(float((own & other).sum() / (own | other).sum()))
        coarse = F.avg_pool2d(texture, 512 // MAP_PX)
        error = (whole(learnt.albedo[row]) - coarse).abs().mean(0)
        weight = whole(fit.seen)
        colour_errors.append(float((error * weight).sum() / weight.sum()))
        distances_m.append(float((learnt.vertices[row] - vertices).norm(dim=1).mean()))
    assert sum(overlaps) / len(overlaps) >= 0.8
    assert sum(colour_errors) / len(colour_errors) < 0.06
    assert sum(distances_m) / len(distances_m) < 0.12


def test_a_stretched_body_is_as_long_as_it_was_fitted(
    prototypes: list[Prototype], made: tuple[Fitter, list[Photographed], list[Fit]]
) -> None:
    _, _, fits = made
    learnt = fitted_vehicles(fits, prototypes)
    for row, dimensions in enumerate(learnt.dimensions):
        length_m, width_m, _ = (
            learnt.vertices[row].amax(0) - learnt.vertices[row].amin(0)
        ).tolist()
        assert length_m == pytest.approx(dimensions.length, abs=0.15)
        assert width_m == pytest.approx(dimensions.width, abs=0.1)


def test_fits_are_stored_and_read_again(
    made: tuple[Fitter, list[Photographed], list[Fit]],
) -> None:
    _, _, fits = made
    stored = Fits([fit.id for fit in fits])
    stored.done = list(fits)
    again = Fits([fit.id for fit in fits])
    again.load_state_dict(stored.state_dict())
    for one, fit in zip(again.done, fits, strict=True):
        assert (one.id, one.prototype, one.reversed) == (fit.id, fit.prototype, fit.reversed)
        assert one.stretch == pytest.approx(fit.stretch)
        assert torch.equal(one.detail, fit.detail)
