"""What a deformed vehicle measures: boxes of known numbers, and a pickup bed that folds."""

import dataclasses

import pytest
import torch

from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.practicality import measure_shape
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from tests.render.bodies import vehicles


def one(body_type):
    fleet = sample_fleet(
        FleetSettings(1, {body_type: 1.0}), generator=torch.Generator().manual_seed(0)
    )
    return fleet.batch(fleet.ids)


def test_a_stretched_body_measures_what_it_was_stretched_by():
    before = vehicles(2)
    stretch = torch.tensor([[[1.5, 1.0, 1.0]], [[1.0, 1.1, 1.2]]])
    first, second = measure_shape(
        before, dataclasses.replace(before, vertices=before.vertices * stretch)
    )
    assert (
        first["added_length_m"],
        first["added_width_m"],
        first["added_height_m"],
    ) == pytest.approx((2.2, 0, 0), abs=1e-5)
    assert (second["added_length_m"], second["added_width_m"]) == pytest.approx((0, 0.18), abs=1e-5)
    assert second["added_height_m"] == pytest.approx(0.3, abs=1e-5)
    assert first["added_volume_m3"] == pytest.approx(first["volume_m3"] / 2, rel=1e-5)
    assert second["added_volume_m3"] == pytest.approx(second["volume_m3"] * 0.32, rel=1e-5)
    assert first["largest_displacement_m"] == pytest.approx(1.1, abs=1e-5)
    assert first["intersections_before"] == first["intersections_after"] == 0


def test_a_body_seen_whole_from_its_middle_never_runs_through_itself():
    # Every ray from the middle meets the surface once, and points only slide along their rays.
    saloon = one("saloon")
    control = DisplacementMap(
        CamouflageName.parse("R-S-O@1"), generator=torch.Generator().manual_seed(0)
    )
    (measures,) = measure_shape(saloon, control(saloon))
    assert measures["intersections_before"] == measures["intersections_after"] == 0
    assert measures["added_volume_m3"] > 5
    assert measures["largest_displacement_m"] > 1.5


def test_the_bed_of_a_pickup_does():
    pickup = one("pickup")
    control = DisplacementMap(
        CamouflageName.parse("R-S-O@0.4"), generator=torch.Generator().manual_seed(0)
    )
    (measures,) = measure_shape(pickup, control(pickup))
    assert measures["intersections_before"] == 0
    assert measures["intersections_after"] > 50
