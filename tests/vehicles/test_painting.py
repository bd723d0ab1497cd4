"""Textures and part labels: plausible, symmetric, at the promised resolution."""

from functools import lru_cache

import pytest
import torch

from skyproof.vehicles.bodies import BODY_RANGES
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from skyproof.vehicles.paints import PAINT_SHARES, sample_paint
from skyproof.vehicles.template import column_u, row_v
from skyproof.vehicles.texels import texel_metric, texel_regions
from skyproof.vehicles.vehicle import Part

TYPES = sorted(BODY_RANGES)


@lru_cache
def _fleet(body_type: str) -> Fleet:
    return sample_fleet(
        FleetSettings(6, {body_type: 1.0}), generator=torch.Generator().manual_seed(2)
    )


@lru_cache
def _area_from_above(body_type: str) -> torch.Tensor:
    """`[6, 512, 512]` square metres that each texel covers from above; 0 where it looks down.

    Overhangs count twice, which is little on a car.
    """
    fleet = _fleet(body_type)
    rings = fleet.vertices[:, :992].view(-1, 31, 32, 3)
    nose, tail = (fleet.vertices[:, i, None, None].expand(-1, 1, 32, 3) for i in (992, 993))
    grid = torch.cat([nose, rings, tail], dim=1)
    grid = torch.cat([grid, grid[:, :, :1]], dim=2)
    down, right = grid.diff(dim=1)[:, :, :-1], grid.diff(dim=2)[:, :-1]
    cell = down[..., 0] * right[..., 1] - down[..., 1] * right[..., 0]
    centre = (torch.arange(512, dtype=torch.float64) + 0.5) / 512
    row, column = (
        torch.searchsorted(row_v(), centre) - 1,
        torch.searchsorted(column_u(), centre) - 1,
    )
    texels = row_v().diff()[:, None] * column_u().diff() * 512**2
    return (cell / texels).clamp(min=0.0)[:, row][:, :, column]


def _share_from_above(body_type: str, part: Part) -> torch.Tensor:
    area = _area_from_above(body_type)
    return (area * (_fleet(body_type).parts == part)).sum((1, 2)) / area.sum((1, 2))


@pytest.mark.parametrize("body_type", TYPES)
def test_part_shares_seen_from_above_are_plausible(body_type: str) -> None:
    glass = _share_from_above(body_type, Part.GLASS)
    # Of a bus one sees the windscreen's upper end.
    assert glass.min() > {"van": 0.06, "bus": 0.01, "lorry": 0.01}.get(body_type, 0.10)
    assert glass.median() < 0.36
    assert glass.max() < 0.43  # with a panorama roof
    body = _share_from_above(body_type, Part.BODY)
    assert body.min() > 0.35
    assert _share_from_above(body_type, Part.UNDERSIDE).max() < 0.005
    assert _share_from_above(body_type, Part.WHEEL).max() < 0.03
    assert _share_from_above(body_type, Part.LIGHT).max() < 0.05


@pytest.mark.parametrize("body_type", TYPES)
def test_every_part_occurs(body_type: str) -> None:
    for parts in _fleet(body_type).parts:
        assert sorted(parts.unique().tolist()) == [int(part) for part in Part]


@pytest.mark.parametrize("body_type", TYPES)
def test_labels_are_symmetric(body_type: str) -> None:
    parts = _fleet(body_type).parts
    assert torch.equal(parts, parts.flip(-1))


@pytest.mark.parametrize("body_type", TYPES)
def test_the_underside_is_at_both_edges_of_the_map(body_type: str) -> None:
    parts = _fleet(body_type).parts
    assert (parts[:, 64:448, :12] == Part.UNDERSIDE).float().mean() > 0.8
    assert not (parts[:, :, 64:448] == Part.UNDERSIDE).any()


@pytest.mark.parametrize("body_type", TYPES)
def test_the_windscreen_reaches_across(body_type: str) -> None:
    for texture, parts in zip(_fleet(body_type).textures, _fleet(body_type).parts, strict=True):
        first = int((parts[:, 256] == Part.GLASS).int().argmax())
        across = parts[first + 12, 200:312] == Part.GLASS
        assert across.sum() > 100
        pane = texture[:, first + 14, 212:300].float() / 255
        # As dark as a cabin, bluer than the black frame, and without a speck of dust.
        assert pane.max() < 0.13
        assert (pane[2] - pane[0]).median() > 0.01
        assert len(pane[:, 4:-4].unique(dim=1).T) <= 2


def test_a_lorry_has_a_gap_behind_its_cab_and_a_bus_things_on_its_roof() -> None:
    def roof_without_paint(body_type: str) -> torch.Tensor:
        return (_fleet(body_type).parts[:, 120:400, 240:272] == Part.TRIM).float().mean((1, 2))

    assert not roof_without_paint("van").any()
    assert roof_without_paint("lorry").min() > 0.01
    assert roof_without_paint("lorry").max() < 0.2
    assert roof_without_paint("bus").min() > 0.05


def test_a_saloon_has_whole_wheels_on_the_ground() -> None:
    parts = _fleet("saloon").parts[:, :, :256]
    wheels = (parts == Part.WHEEL).sum((1, 2))
    assert (
        wheels.min() > 5000
    )  # two discs of 0.32 m radius at 1 cm per texel are 6400, and some tread
    assert wheels.max() < 12000


def test_glass_is_darker_than_white_paint_and_wheels_are_low() -> None:
    fleet = _fleet("van")
    brightness = fleet.textures.float().mean(1) / 255
    assert brightness[fleet.parts == Part.GLASS].median() < 0.3
    assert (
        max(
            values[parts == Part.BODY].median()
            for values, parts in zip(brightness, fleet.parts, strict=True)
        )
        > 0.7
    )
    assert not (fleet.parts[:, :, 110:402] == Part.WHEEL).any()


def test_texel_sizes_of_a_saloon() -> None:
    fleet = _fleet("saloon")
    vehicles = fleet.batch(fleet.ids)
    regions = texel_regions(vehicles)
    for length_m in texel_metric(vehicles)[:2]:
        assert 0.008 <= length_m[regions["roof"]].median() <= 0.013
        assert 0.007 <= length_m[regions["bonnet"]].median() <= 0.016
        assert 0.007 <= length_m[regions["sides"]].median() <= 0.016


def test_paint_follows_the_shares_and_no_white_burns_out() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = [sample_paint("saloon", generator=generator) for _ in range(3000)]
    names = [name for name, _ in drawn]
    assert 0.85 < max(float(paint.max()) for _, paint in drawn) <= 0.91 + 1e-6
    assert sum(PAINT_SHARES.values()) == pytest.approx(1.0)
    for name, share in PAINT_SHARES.items():
        assert names.count(name) / 3000 == pytest.approx(share, abs=0.03)
    vans = [sample_paint("van", generator=generator)[0] for _ in range(500)]
    assert vans.count("white") / 500 > 0.7
