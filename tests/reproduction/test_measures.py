"""Textures measured on a flat body (texels of 1 × 2 cm between the rings), counted by hand."""

import pytest
import torch

from skyproof.reproduction.practicality import mean_measures, measure_texture
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import Part
from tests.vehicles.flat_body import flat_bodies

RED, BLUE = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])


def two_colours(red: torch.Tensor) -> torch.Tensor:
    return torch.where(red.expand(512, 512), RED[:, None, None], BLUE[:, None, None])


def inner_rows(count: int = 1) -> torch.Tensor:
    """The texels between the first and the last ring, 480 of 512 rows."""
    mask = torch.zeros(count, 512, 512, dtype=torch.bool)
    mask[:, 16:496] = True
    return mask


def test_one_colour_has_no_boundary():
    (measures,) = measure_texture(
        flat_bodies(1), two_colours(torch.tensor(True)), inner_rows(), None
    )
    assert measures["painted_area_m2"] == pytest.approx(5.12 * 9.60, rel=1e-5)
    assert (measures["colours"], measures["regions"], measures["boundary_m"]) == (1, 1, 0.0)
    assert not any("block" in name for name in measures)


def test_a_front_and_a_rear_half_meet_once_around_the_body():
    front = (torch.arange(512) < 256)[:, None]
    (measures,) = measure_texture(flat_bodies(1), two_colours(front), inner_rows(), None)
    assert (measures["colours"], measures["regions"]) == (2, 2)
    assert measures["boundary_m"] == pytest.approx(5.12, rel=1e-5)


def test_two_sides_meet_twice_along_the_body_once_of_it_across_the_seam():
    (measures,) = measure_texture(
        flat_bodies(1), two_colours(torch.arange(512) < 100), inner_rows(), None
    )
    assert (measures["colours"], measures["regions"]) == (2, 2)
    assert measures["boundary_m"] == pytest.approx(2 * 9.60, rel=1e-5)


def test_one_colour_on_both_sides_of_the_seam_is_one_region():
    column = torch.arange(512)
    (measures,) = measure_texture(
        flat_bodies(1), two_colours((column < 100) | (column >= 400)), inner_rows(), None
    )
    assert measures["regions"] == 2
    assert measures["boundary_m"] == pytest.approx(2 * 9.60, rel=1e-5)


def test_a_checkerboard_of_blocks():
    block = torch.arange(512) // 16
    checkerboard = two_colours((block[:, None] + block) % 2 == 0)
    (measures,) = measure_texture(flat_bodies(1), checkerboard, inner_rows(), 16)
    assert (
        measures["blocks"] == measures["regions"] == 30 * 32
    )  # squares that touch at corners alone are apart
    # 30 × 32 edges of 16 × 2 cm along, 29 × 32 edges of 16 × 1 cm around the body.
    assert measures["boundary_m"] == pytest.approx(30 * 32 * 0.32 + 29 * 32 * 0.16, rel=1e-5)
    assert (measures["block_sides_u_cm"], measures["block_sides_v_cm"]) == pytest.approx(
        (16.0, 32.0), rel=1e-5
    )


def test_what_is_not_painted_counts_nowhere():
    block = torch.arange(512) // 16
    checkerboard = two_colours((block[:, None] + block) % 2 == 0)
    mask = torch.zeros(2, 512, 512, dtype=torch.bool)
    mask[0, 96:128, 207:224] = True  # one column of a block and a whole block, two rows of blocks
    mask[1, 100, 100] = True
    first, second = measure_texture(flat_bodies(1, 2), checkerboard, mask, 16)
    assert (first["colours"], first["regions"], first["blocks"]) == (2, 4, 4)
    assert first["painted_area_m2"] == pytest.approx(0.17 * 0.64, rel=1e-5)
    assert first["boundary_m"] == pytest.approx(
        0.64 + 0.17, rel=1e-5
    )  # not the rim, though colours change there
    assert (second["colours"], second["regions"], second["blocks"], second["boundary_m"]) == (
        1,
        1,
        1,
        0.0,
    )
    assert second["painted_area_m2"] == pytest.approx(0.02 * 0.04, rel=1e-5)
    assert (second["block_sides_u_cm"], second["block_sides_v_cm"]) == pytest.approx(
        (32.0, 64.0), rel=1e-5
    )


def test_an_empty_mask_measures_nothing():
    mask = torch.zeros(1, 512, 512, dtype=torch.bool)
    (measures,) = measure_texture(flat_bodies(1), two_colours(torch.arange(512) < 100), mask, 16)
    assert (measures["painted_area_m2"], measures["boundary_m"]) == (0.0, 0.0)
    assert (measures["colours"], measures["regions"], measures["blocks"]) == (0, 0, 0)


def test_without_mask_all_but_the_underside_is_painted():
    vehicles = flat_bodies(1)
    vehicles.parts[:] = int(Part.UNDERSIDE)
    vehicles.parts[:, 100:200, 200:300] = int(Part.GLASS)
    vehicles.parts[:, 200:250, 200:300] = int(Part.BODY)
    (measures,) = measure_texture(vehicles, two_colours(torch.tensor(True)), None, None)
    assert measures["painted_area_m2"] == pytest.approx(1.0 * 3.0, rel=1e-5)


def test_colours_are_told_apart_as_bytes():
    texture = torch.full((3, 512, 512), 100.0 / 255)
    texture[0, :, 256:] += 0.3 / 255
    as_bytes = (texture * 255).round().byte()
    (measures,) = measure_texture(flat_bodies(1), texture, None, None)
    assert (measures["colours"], measures["regions"]) == (1, 1)
    assert measure_texture(flat_bodies(1), as_bytes, None, None) == [measures]
    texture[0, :, 256:] += 0.3 / 255
    (measures,) = measure_texture(flat_bodies(1), texture, None, None)
    assert (measures["colours"], measures["regions"]) == (2, 2)


def test_noise_on_real_vehicles():
    fleet = sample_fleet(FleetSettings(2, {"suv": 1.0}), generator=torch.Generator().manual_seed(0))
    vehicles = fleet.batch(fleet.ids)
    noise = torch.rand(3, 512, 512, generator=torch.Generator().manual_seed(0))
    body = vehicles.parts == Part.BODY
    bare = measure_texture(vehicles, noise, None, 16)
    masked = measure_texture(vehicles, noise, body, 16)
    for one, other, mask in zip(bare, masked, body, strict=True):
        assert other["painted_area_m2"] < one["painted_area_m2"]
        # Of 2^24 colours nearly all are free: almost every texel is a colour and a region.
        assert int(mask.sum()) * 0.98 < other["colours"] < other["regions"] <= int(mask.sum())
        regions = {name.split("_")[1] for name in other if name.startswith("block_")}
        assert regions == {"roof", "bonnet", "sides"}


def test_means_over_vehicles_have_flat_names():
    vehicles = flat_bodies(1, 3)
    halves = two_colours((torch.arange(512) < 256)[:, None])
    mean = mean_measures(measure_texture(vehicles, halves, inner_rows(2), 16))
    assert mean["boundary_m"] == pytest.approx(2 * 5.12, rel=1e-5)
    assert mean["painted_area_m2"] == pytest.approx(5 * 5.12 * 9.60, rel=1e-5)
    assert mean["blocks"] == 960
    assert (mean["block_sides_u_cm"], mean["block_sides_v_cm"]) == pytest.approx(
        (32.0, 64.0), rel=1e-5
    )
    without = mean_measures(measure_texture(vehicles, halves, inner_rows(2), None))
    assert set(without) == {"painted_area_m2", "colours", "boundary_m", "regions"}
