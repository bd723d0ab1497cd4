"""Bodies keep to their dimensions, are symmetric, closed and turned outward."""

import pytest
import torch
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.vehicles.bodies import BODY_RANGES, Body, build_body, sample_dimensions
from skyproof.vehicles.template import COLUMNS, RINGS, make_template

TEMPLATE = make_template()
TYPES = sorted(BODY_RANGES)


def _bodies(body_type: str, count: int = 12) -> list[Body]:
    generator = torch.Generator().manual_seed(5)
    return [build_body(sample_dimensions(body_type, generator=generator)) for _ in range(count)]


def _rings(body: Body) -> Tensor:
    return body.vertices[: RINGS * COLUMNS].view(RINGS, COLUMNS, 3)


@pytest.mark.parametrize("body_type", TYPES)
def test_size_is_as_drawn_and_in_range(body_type: str) -> None:
    ranges = BODY_RANGES[body_type]
    for body in _bodies(body_type):
        low, high = body.vertices.amin(0), body.vertices.amax(0)
        size = (high - low).tolist()
        for value, name in zip(size, ("length", "width", "height"), strict=True):
            smallest, largest = ranges[name]
            assert smallest - 1e-4 <= value <= largest + 1e-4
            assert value == pytest.approx(getattr(body.dimensions, name), abs=1e-4)
        assert abs(float(low[2])) < 1e-6
        assert abs(float(low[0] + high[0])) < 1e-5


@pytest.mark.parametrize("body_type", TYPES)
def test_mirror_is_exact(body_type: str) -> None:
    for body in _bodies(body_type):
        reflected = body.vertices * torch.tensor([1.0, -1.0, 1.0])
        assert (body.vertices[TEMPLATE.mirror] - reflected).abs().max() <= 1e-6


@pytest.mark.parametrize("body_type", TYPES)
def test_surface_is_turned_outward_with_a_plausible_volume(body_type: str) -> None:
    for body in _bodies(body_type):
        a, b, c = body.vertices.double()[TEMPLATE.faces].unbind(1)
        volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
        box = body.dimensions.length * body.dimensions.width * body.dimensions.height
        assert (0.45 if body_type == "pickup" else 0.5) * box < volume < 0.9 * box


@pytest.mark.parametrize("body_type", TYPES)
def test_rings_follow_each_other_from_nose_to_tail(body_type: str) -> None:
    for body in _bodies(body_type):
        columns = torch.cat([body.vertices[992].expand(1, COLUMNS, 3), _rings(body)])
        columns = torch.cat([columns, body.vertices[993].expand(1, COLUMNS, 3)])[..., 0]
        assert (columns.diff(dim=0) < 0).all()


@pytest.mark.parametrize("body_type", TYPES)
def test_rings_are_simple_polygons(body_type: str) -> None:
    """Seen along the vehicle, no two edges of a ring cross; rings in order of x then keep apart."""

    def side(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
        return (q - p)[..., 0] * (r - p)[..., 1] - (q - p)[..., 1] * (r - p)[..., 0]

    for body in _bodies(body_type, count=4):
        start = _rings(body)[..., 1:].double()
        end = start.roll(-1, dims=1)
        p, q, r, s = start[:, :, None], end[:, :, None], start[:, None], end[:, None]
        crossing = (side(p, q, r) * side(p, q, s) < -1e-12) & (
            side(r, s, p) * side(r, s, q) < -1e-12
        )
        assert not crossing.any()


@pytest.mark.parametrize("body_type", TYPES)
def test_all_four_wheels_reach_the_ground(body_type: str) -> None:
    for body in _bodies(body_type):
        d = body.dimensions
        vertices = body.vertices
        for axle in (
            d.length / 2 - d.front_overhang,
            d.length / 2 - d.front_overhang - d.wheelbase,
        ):
            # A long vehicle's rings are further apart.
            near = (vertices[:, 0] - axle).abs() < max(0.2, float(body.station.diff().max()) / 2)
            assert vertices[near & (vertices[:, 1] > 0.5), 2].min() < 0.005


def test_pickup_bed_is_open() -> None:
    for body in _bodies("pickup"):
        middle = _rings(body)[:, COLUMNS // 2]
        in_bed = middle[:, 0] < -body.dimensions.length / 2 + 1.0
        assert middle[in_bed, 2].min() < body.dimensions.deck_height - 0.4


def test_unknown_body_type() -> None:
    with pytest.raises(ConfigurationError, match="hovercraft"):
        sample_dimensions("hovercraft", generator=torch.Generator())
