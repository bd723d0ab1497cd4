"""The displacement map: how far vertices move, which do not; it stays symmetric, and learns."""

import dataclasses
import math

import pytest
import torch

from skyproof.camouflage.displacement import DisplacementMap, sample_map
from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import Part
from tests.render.bodies import double, vehicles

MIRROR = torch.tensor([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def cars():
    """One vehicle of each body type but the van."""
    types = ("saloon", "hatchback", "estate", "suv", "pickup")
    batches = [
        sample_fleet(FleetSettings(1, {name: 1.0}), generator=torch.Generator().manual_seed(seed))
        for seed, name in enumerate(types)
    ]
    return dataclasses.replace(
        batches[0].batch(batches[0].ids),
        vertices=torch.cat([fleet.vertices for fleet in batches]),
        texture=torch.cat([fleet.textures for fleet in batches]),
        parts=torch.cat([fleet.parts for fleet in batches]),
        ids=tuple(name for fleet in batches for name in fleet.ids),
    )


def named(magnitude):
    return CamouflageName("shape", magnitude=magnitude)


def filled(value, magnitude=0.4, **options):
    """A map of one value, or of a `[64, 64]` tensor of them."""
    camouflage = DisplacementMap(named(magnitude), **options)
    with torch.no_grad():
        camouflage.reach.copy_(torch.as_tensor(value).expand(64, 64))
    return camouflage


def random_map(magnitude, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    return DisplacementMap(named(magnitude), generator=generator, **options)


def radii(batch):
    """Unit vectors from the mean of the vertices, and the distances."""
    radius = batch.vertices.double() - batch.vertices.double().mean(1, keepdim=True)
    length = radius.norm(dim=-1)
    return radius / length[..., None], length


def moved(camouflage, batch):
    with torch.no_grad():
        return camouflage(batch).vertices - batch.vertices


def labels_at_vertices(batch, inset=0.0):
    """The part under each vertex, read on the left half only, because labels are symmetric."""
    u, v = batch.template.vertex_uvs.unbind(1)
    column = (torch.minimum(u, 1 - u) * 512 - inset).long().clamp(min=0)
    return batch.parts[:, (v * 512).long().clamp(max=511), column]


def test_without_a_generator_it_starts_half_way_out(cars):
    camouflage = DisplacementMap(named(1.0))
    assert (camouflage.reach == 0.5).all()
    width = cars.vertices[..., 1].amax(1) - cars.vertices[..., 1].amin(1)
    assert torch.allclose(moved(camouflage, cars).norm(dim=-1).amax(1), 0.5 * width)


def test_the_papers_map_starts_with_zeros_and_is_shown_by_its_sigmoid(cars):
    camouflage = DisplacementMap(named(0.6))
    camouflage.paper_form_(True)
    assert (camouflage.reach == 0).all()
    change = moved(camouflage, cars).double()
    direction, _ = radii(cars)
    width = (cars.vertices[..., 1].amax(1) - cars.vertices[..., 1].amin(1)).double()
    half_way = (0.5 * 0.6 * width)[:, None, None] * direction
    far = change.norm(dim=-1) > 0.99 * 0.5 * 0.6 * width[:, None]
    assert far.float().mean() > 0.3
    assert (change - half_way)[far].abs().max() < 1e-5
    # The slope of the sigmoid at zero is a quarter, and mirrored texels share it.
    camouflage.map()[20, 10].backward()
    assert camouflage.reach.grad[20, 10] == camouflage.reach.grad[20, 53] == 0.125
    with torch.no_grad():
        camouflage.reach[20, 10] = 3.0
        camouflage.reach[40, 10] = -9.0
    camouflage.project_()
    assert camouflage.reach[40, 10] == -9.0
    shown = camouflage.map().detach()
    assert float(shown[20, 53]) == pytest.approx(1 / (1 + math.exp(-1.5)))
    before = moved(camouflage, cars)
    camouflage.finalise()
    assert torch.equal(camouflage.reach.detach(), shown)
    assert torch.allclose(moved(camouflage, cars), before, atol=1e-6)


@pytest.mark.parametrize("magnitude", [0.1, 0.4, 1.0])
def test_no_vertex_moves_further_than_pm_times_the_width_and_none_inward(cars, magnitude):
    change = moved(random_map(magnitude), cars).double()
    width = (cars.vertices[..., 1].amax(1) - cars.vertices[..., 1].amin(1)).double()
    direction, _ = radii(cars)
    along = (change * direction).sum(-1)
    assert (change.norm(dim=-1) <= magnitude * width[:, None] + 1e-6).all()
    assert (along >= -1e-6).all()
    # Nothing sideways, and the bound is nearly reached.
    assert (change - along[..., None] * direction).abs().max() < 1e-6
    assert (along.amax(1) > 0.9 * magnitude * width).all()


def test_at_pm_zero_the_vertices_are_the_same_bit_for_bit(cars):
    # Adding zeros would turn -0.0 into 0.0.
    cars = dataclasses.replace(cars, vertices=torch.where(cars.vertices == 0, -0.0, cars.vertices))
    changed = random_map(0.0)(cars)
    assert torch.equal(changed.vertices.view(torch.int32), cars.vertices.view(torch.int32))


def test_texture_parts_and_ids_stay(cars):
    change = random_map(0.5)(cars)
    assert change.texture is cars.texture
    assert change.parts is cars.parts
    assert change.ids == cars.ids


@pytest.mark.parametrize("frozen_parts", [True, False])
def test_mirrored_vertices_move_alike(cars, frozen_parts):
    camouflage = random_map(1.0, frozen_parts=frozen_parts)
    with torch.no_grad():
        noise = torch.rand(64, 64, generator=torch.Generator().manual_seed(1))
        camouflage.reach.copy_(noise)
        changed = camouflage(cars).vertices
    assert (changed - changed[:, cars.template.mirror] * MIRROR).abs().max() < 1e-6
    assert (changed - cars.vertices).norm(dim=-1).max() > 1.0


def test_both_halves_of_the_map_count_alike():
    camouflage = DisplacementMap(named(0.5))
    with torch.no_grad():
        camouflage.reach[20, 10] = 0.1
    shown = camouflage.map().detach()
    assert shown[20, 10] == shown[20, 53]
    assert float(shown[20, 10]) == pytest.approx((0.1 + 0.5) / 2)


def test_a_displacement_computed_by_hand():
    # Vertex 32 * 9 + 5 of the sphere template has u = 5/32, v = 10/32: between the centres of
    # columns 9 and 10 and of rows 19 and 20, half way each. Its mirror image has columns 53 and 54.
    batch = double(vehicles())
    camouflage = DisplacementMap(named(0.5)).double()
    with torch.no_grad():
        for row, column, value in ((19, 9, 0.1), (19, 10, 0.2), (20, 9, 0.9), (20, 10, 0.4)):
            camouflage.reach[row, column] = value
            camouflage.reach[row, 63 - column] = value
    index = 32 * 9 + 5
    points = batch.vertices[0]
    radius = points[index] - points.sum(0) / len(points)
    width = points[:, 1].max() - points[:, 1].min()
    wanted = 0.5 * width * 0.4 * radius / radius.square().sum().sqrt()
    assert wanted[2] > -0.2
    assert torch.allclose(moved(camouflage, batch)[0, index], wanted, rtol=0, atol=1e-12)


def test_the_map_is_circular_in_u():
    # Columns 63 and 0 meet at u = 0 (and 1): there half of each is read, beside it nearly so.
    values = torch.linspace(-3.0, 5.0, 64).expand(64, 64)
    beside, before, at, inside = sample_map(
        values, torch.tensor([[1e-6, 0.3], [1 - 1e-6, 0.3], [0, 0.3], [0.25, 0.3]])
    )
    assert float(at) == pytest.approx(1.0)
    assert float(beside) == pytest.approx(1.0, abs=1e-3)
    assert float(before) == pytest.approx(1.0, abs=1e-3)
    assert float(inside) == pytest.approx(-3 + 8 * 15.5 / 63, abs=1e-4)


def test_vertices_at_both_ends_of_the_seam_move_alike():
    batch = vehicles()
    uvs = batch.template.vertex_uvs.clone()
    uvs[:2] = torch.tensor([[1e-6, 0.3], [1 - 1e-6, 0.3]])
    radius = torch.tensor([0.3, 0.0, 0.4])
    batch = dataclasses.replace(
        batch,
        template=dataclasses.replace(batch.template, vertex_uvs=uvs),
        vertices=torch.cat(
            (batch.vertices.mean(1, keepdim=True) + radius.expand(1, 2, 3), batch.vertices[:, 2:]),
            1,
        ),
    )
    change = moved(filled(torch.linspace(0.2, 0.9, 64)), batch)[0, :2]
    assert change[0].norm() > 0.3
    assert (change[0] - change[1]).abs().max() < 1e-5


def test_the_poles_read_the_first_and_last_row():
    # Half a texel of the map's rows lies beyond the last centre; a wrap would mix nose and tail.
    values = torch.full((64, 64), 0.5)
    values[0], values[-1] = 0.1, 0.8
    batch = vehicles()
    length = moved(filled(values, magnitude=1.0), batch)[0].norm(dim=-1)
    assert float(length[-2]) == pytest.approx(0.1 * 1.8, abs=1e-5)
    assert float(length[-1]) == pytest.approx(0.8 * 1.8, abs=1e-5)


def test_the_gradient_is_the_derivative():
    batch = double(vehicles())
    camouflage = random_map(0.6).double()
    rows, columns = torch.tensor([19, 19, 20, 20, 40]), torch.tensor([9, 10, 53, 54, 32])
    base = camouflage.reach.detach()

    def some(values):
        changed = torch.func.functional_call(
            camouflage, {"reach": base.index_put((rows, columns), values)}, (batch,)
        )
        return changed.vertices[0, [32 * 9 + 5, 32 * 9 + 27, 32 * 19 + 16, 2]]

    values = base[rows, columns].clone().requires_grad_()
    assert torch.autograd.gradcheck(some, (values,))
    some(values)[..., 0].sum().backward()
    assert (values.grad != 0).all()


def test_wheels_and_underside_stay_unless_asked(cars):
    labels = labels_at_vertices(cars)
    fixed = (labels == Part.WHEEL) | (labels == Part.UNDERSIDE)
    assert (fixed.sum(1) > 100).all()
    change = moved(filled(0.9), cars)
    assert (change[fixed] == 0).all()
    # Everything else moves, but for their border: the sill is the edge of the underside.
    beside = labels_at_vertices(cars, inset=0.5)
    free = ~fixed & (beside != Part.WHEEL) & (beside != Part.UNDERSIDE)
    assert (free.sum(1) > 700).all()
    assert (change[free].norm(dim=-1) > 0.2).all()
    assert (
        moved(filled(0.9, frozen_parts=False), cars)[labels == Part.WHEEL].norm(dim=-1) > 0
    ).any()


def test_nothing_goes_below_the_ground_and_the_direction_is_kept(cars):
    camouflage = filled(0.99, magnitude=1.0, frozen_parts=False)
    changed = camouflage(cars).vertices.detach()
    assert changed[..., 2].min() > -1e-6
    stopped = (changed[..., 2].abs() < 1e-6) & (cars.vertices[..., 2] > 0.05)
    assert stopped.sum() > 50
    direction, _ = radii(cars)
    change = (changed - cars.vertices).double()
    assert (torch.linalg.cross(change, direction)[stopped].abs() < 1e-6).all()


def test_the_random_control_is_uniform_and_symmetric():
    camouflage = random_map(0.4)
    drawn = camouflage.map().detach()
    assert torch.allclose(drawn, drawn.flip(1), rtol=0, atol=0)
    left = drawn[:, :32].flatten().sort().values
    even = (torch.arange(2048) + 0.5) / 2048
    # Kolmogorov-Smirnov: above 1.95 / sqrt(n) one draw in a thousand.
    assert (left - even).abs().max() < 1.95 / math.sqrt(2048)
    assert torch.equal(camouflage.reach, random_map(0.4).reach)
    assert not torch.equal(camouflage.reach, random_map(0.4, seed=1).reach)


def test_projection_clips_the_map_and_the_finish_makes_it_symmetric(cars):
    camouflage = DisplacementMap(named(0.4))
    with torch.no_grad():
        camouflage.reach.copy_(torch.randn(64, 64, generator=torch.Generator().manual_seed(0)))
        camouflage.project_()
    assert camouflage.reach.detach().aminmax() == (0.0, 1.0)
    before = moved(camouflage, cars)
    camouflage.finalise()
    assert torch.equal(camouflage.reach, camouflage.reach.flip(1))
    assert torch.equal(moved(camouflage, cars), before)
    assert camouflage.reach.requires_grad


def test_what_was_pushed_to_an_end_comes_back(cars):
    # First the roof is worth pulling in, then pushing out: neither end of the map holds it.
    camouflage = DisplacementMap(named(0.4))
    optimiser = torch.optim.Adam(camouflage.parameters(), lr=0.05)
    for sign, end in ((1.0, 0.0), (-1.0, 1.0)):
        for _ in range(40):
            optimiser.zero_grad()
            (sign * camouflage(cars).vertices[..., 2].sum()).backward()
            optimiser.step()
            camouflage.project_()
        assert float(camouflage.map().detach()[32, 32]) == pytest.approx(end, abs=0.05)


@pytest.mark.parametrize("magnitude", [-0.1, 1.1, math.nan, math.inf])
def test_a_magnitude_outside_zero_to_one_is_one_clear_sentence(magnitude):
    with pytest.raises(ConfigurationError, match=r"from 0 to 1.*got"):
        named(magnitude)


def test_a_name_without_a_magnitude_is_refused():
    with pytest.raises(ConfigurationError, match=r"such as S-O@0\.4, got T-U"):
        DisplacementMap(CamouflageName.parse("T-U"))
