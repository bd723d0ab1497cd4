"""Size of texels: on a flat body by hand, on real vehicles against the mesh's own area."""

import torch
import trimesh

from skyproof.vehicles.bodies import BODY_RANGES
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.texels import texel_metric, texel_regions
from tests.vehicles.flat_body import LENGTH_M, WIDTH_M, flat_bodies


def test_a_flat_body_has_texels_of_one_by_two_centimetres():
    length_u, length_v, area = texel_metric(flat_bodies(1))
    inner = slice(16, 496)
    assert torch.allclose(length_u[:, inner], torch.tensor(0.01))
    assert torch.allclose(length_v[:, inner], torch.tensor(0.02))
    assert torch.allclose(area[:, inner], torch.tensor(0.0002))


def test_at_the_poles_rows_narrow_evenly_to_half_the_area_of_others():
    length_u, _, area = texel_metric(flat_bodies(1))
    narrowing = 0.01 * (torch.arange(16) + 0.5) / 16
    assert torch.allclose(length_u[0, :16, 300], narrowing)
    assert torch.allclose(length_u[0, 496:, 300], narrowing.flip(0))
    # 32 triangles with bases of together WIDTH_M and the height of one interval.
    cap = WIDTH_M * LENGTH_M / 32 / 2
    assert torch.isclose(area[0, :16].sum(), torch.tensor(cap))
    assert torch.isclose(area[0, 496:].sum(), torch.tensor(cap))
    assert torch.isclose(area[0, 15, 300] / area[0, 0, 300], torch.tensor(31.0))
    assert torch.allclose(area[0, 496:], area[0, :16].flip(0))


def test_twice_as_large_is_four_times_the_area():
    _, _, area = texel_metric(flat_bodies(1, 2))
    assert torch.allclose(area[1], 4 * area[0])


def test_texels_add_up_to_the_area_of_the_mesh():
    for body_type in BODY_RANGES:
        fleet = sample_fleet(
            FleetSettings(2, {body_type: 1.0}), generator=torch.Generator().manual_seed(4)
        )
        vehicles = fleet.batch(fleet.ids)
        length_u, length_v, area = texel_metric(vehicles)
        for vertices, texels in zip(vehicles.vertices, area, strict=True):
            mesh = trimesh.Trimesh(
                vertices.double().numpy(), vehicles.template.faces.numpy(), process=False
            )
            assert abs(float(texels.double().sum()) / mesh.area - 1) < 1e-4
        # On the roof the grid is nearly square, so lengths and areas, computed apart, must agree.
        roof = texel_regions(vehicles)["roof"]
        assert abs(float((length_u * length_v)[roof].sum() / area[roof].sum()) - 1) < 0.02


def test_lengths_add_up_to_girth_and_mirrored_sides_agree():
    fleet = sample_fleet(
        FleetSettings(1, {"saloon": 1.0}), generator=torch.Generator().manual_seed(4)
    )
    length_u, length_v, area = texel_metric(fleet.batch(fleet.ids))
    for values in (length_u, length_v, area):
        assert torch.allclose(values, values.flip(2), rtol=1e-3)
    # A row's girth lies between those of the two rings it runs between, measured on the vertices;
    # it may be a little less, because halfway between two unlike rings the surface is smoother than
    # either.
    rings = fleet.vertices[0, :992].view(31, 32, 3)
    girth = (rings.roll(-1, 1) - rings).norm(dim=-1).sum(1)
    rows = length_u[0, 16:496].sum(1).view(30, 16)
    low, high = torch.minimum(girth[:-1], girth[1:]), torch.maximum(girth[:-1], girth[1:])
    assert (rows <= high[:, None] + 1e-4).all()
    assert (rows >= 0.97 * low[:, None]).all()
