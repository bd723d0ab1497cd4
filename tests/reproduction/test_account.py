"""One account per camouflage: signs from its constraints, quantities from the vehicles."""

import pytest
import torch

from skyproof.camouflage.make import make_camouflage
from skyproof.reproduction.practicality import measure_texture, practicality_account
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

PALETTE = (
    torch.tensor([[0, 0, 0], [60, 80, 40], [120, 110, 90], [200, 190, 170], [255, 0, 51]]) / 255
)


@pytest.fixture(scope="module")
def vehicles():
    fleet = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))
    return fleet.batch(fleet.ids)


def account(name, vehicles):
    generator = torch.Generator().manual_seed(0)
    return practicality_account(
        make_camouflage(name, palette=PALETTE, generator=generator), vehicles
    )


@pytest.mark.parametrize(
    ("name", "total", "painted", "deformed"),
    [
        ("R-U", -3, True, False),
        ("R-PixFcMa", 3, True, False),
        ("R-S-O@0.2", -3, False, True),
        ("R-S-O@0", 0, False, False),
        ("R-C-PixFc@0.2", -2, True, True),
        ("R-C-PixFc@0", 1, True, False),
    ],
)
def test_sides_that_are_left_alone_are_not_accounted_for(vehicles, name, total, painted, deformed):
    found = account(name, vehicles)
    assert found["name"] == name
    assert found["score"]["total"] == total
    assert (found["texture"] is not None) == painted
    assert (found["shape"] is not None) == deformed


def test_quantities_are_those_of_the_map_and_the_mask(vehicles):
    control = make_camouflage(
        "R-PixFcMa", palette=PALETTE, generator=torch.Generator().manual_seed(0)
    )
    found = practicality_account(control, vehicles)["texture"]
    wanted = measure_texture(vehicles, control.bytes(), control.mask(vehicles), 16)
    assert found["painted_area_m2"] == pytest.approx(
        sum(one["painted_area_m2"] for one in wanted) / 2
    )
    assert found["blocks"] == sum(one["blocks"] for one in wanted) / 2
    assert found["colours"] == 5


def test_a_random_shape_adds_volume(vehicles):
    found = account("R-S-O@0.4", vehicles)["shape"]
    assert found["added_volume_m3"] > 1
    assert 0.2 < found["largest_displacement_m"] <= 0.4 * 2.3
