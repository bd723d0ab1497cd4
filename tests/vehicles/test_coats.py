"""Coats beyond catalogue paints, and the fleets that wear them."""

from collections import Counter

import pytest
import torch

from skyproof.camouflage import random_controls
from skyproof.camouflage.random_controls import RandomPatterns, wear_random_shapes
from skyproof.errors import ConfigurationError
from skyproof.geometry.colour import srgb_to_cielab
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from skyproof.vehicles.paints import varied_colours
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety
from skyproof.vehicles.vehicle import Part

_PAINTS = PaintVariety(plain=0.25, two_tone=0.125, livery=0.125, patterned=0.25)


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _varied(count: int = 24, shapes: float = 0.0) -> Fleet:
    settings = FleetSettings(count=count, paints=_PAINTS, shapes=shapes)
    return sample_fleet(settings, generator=_generator())


def _coat(fleet: Fleet, name: str) -> str:
    return fleet.sources.get(name, {}).get("coat", "catalogue")


def test_varied_colours_fill_what_srgb_shows_of_cielab_and_half_are_muted() -> None:
    colours = varied_colours(2000, generator=_generator())
    assert float(colours.min()) > 0.0299
    assert float(colours.max()) < 0.9701
    cielab = srgb_to_cielab(colours)
    # Equal halves of a lightness range that sRGB fills about evenly are about equally often met.
    lightness = cielab[:, 0]
    darker = ((lightness > 40) & (lightness < 55)).sum()
    brighter = ((lightness > 55) & (lightness < 70)).sum()
    assert 0.75 < float(darker) / float(brighter) < 1.33
    # Of catalogue paints four in five are grey; of these a fifth. Uniform in CIELAB it would be
    # one in fifty, and vivid ones would be twice as many.
    chroma = cielab[:, 1:].norm(dim=1)
    assert 0.12 < float((chroma < 10).float().mean()) < 0.3
    assert 0.25 < float((chroma > 40).float().mean()) < 0.6
    assert min(_quarters(cielab)) > 0.1


def _hue(cielab: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.atan2(cielab[:, 2], cielab[:, 1]))


def _quarters(cielab: torch.Tensor) -> list[float]:
    quarter = torch.floor(((_hue(cielab) + 45) % 360) / 90)
    return [float((quarter == number).float().mean()) for number in range(4)]


def test_two_in_three_two_tone_coats_are_dark_and_light() -> None:
    fleet = sample_fleet(
        FleetSettings(count=40, paints=PaintVariety(0.0, 1.0, 0.0, 0.0)), generator=_generator()
    )
    opposed = []
    for texture, parts in zip(fleet.textures, fleet.parts, strict=True):
        painted = srgb_to_cielab(texture[:, parts == Part.BODY].T.float() / 255)[:, 0]
        low, high = painted.quantile(0.03), painted.quantile(0.97)
        # Dust and seams move both by a little.
        opposed.append(float(low) < 32 and float(high) > 75)
    assert 0.3 < sum(opposed) / len(opposed) < 0.75


def test_the_shares_are_exact_and_recorded() -> None:
    fleet = _varied()
    assert Counter(_coat(fleet, name) for name in fleet.ids) == {
        "plain": 6,
        "two_tone": 3,
        "livery": 3,
        "patterned": 6,
        "catalogue": 6,
    }
    assert fleet.settings is not None
    assert fleet.settings.paints == _PAINTS


def test_without_variety_a_fleet_is_what_it_always_was() -> None:
    usual = sample_fleet(FleetSettings(count=6), generator=_generator(3))
    named = sample_fleet(FleetSettings(count=6, paints=CATALOGUE_PAINTS), generator=_generator(3))
    assert torch.equal(usual.textures, named.textures)
    assert torch.equal(usual.vertices, named.vertices)
    assert not usual.sources
    worn = usual.batch(usual.ids)
    assert RandomPatterns(usual)(worn).texture is worn.texture


def test_coats_cover_the_body_and_half_of_the_plain_ones_glass_too() -> None:
    fleet = _varied(48)
    covered = []
    for name in fleet.ids:
        vehicle = fleet.batch([name])
        body = vehicle.parts[0] == Part.BODY
        glass = vehicle.parts[0] == Part.GLASS
        paint = vehicle.texture[0][:, body].float() / 255
        pane = vehicle.texture[0][:, glass].float() / 255
        spread = float(paint.std(dim=1).mean())
        if _coat(fleet, name) == "plain":
            # Seams, dust and a black roof apart, one colour.
            off = (paint - paint.median(dim=1, keepdim=True).values).abs().amax(dim=0)
            assert float((off < 0.1).float().mean()) > 0.7
            covered.append(float((pane.mean(dim=1) - paint.mean(dim=1)).abs().max()) < 0.05)
            if covered[-1]:
                continue
        if _coat(fleet, name) in ("two_tone", "livery"):
            assert spread > 0.02
        assert float(pane.mean()) < 0.35
    assert 3 <= sum(covered) <= 9
    assert len(covered) == 12


def test_patterns_are_laid_on_marked_vehicles_alone_and_are_others_in_every_image() -> None:
    fleet = _varied(72)
    marked = [name for name in fleet.ids if _coat(fleet, name) == "patterned"]
    dress = RandomPatterns(fleet)
    vehicles = fleet.batch(fleet.ids)
    worn = dress(vehicles)
    whole = 0
    for row, name in enumerate(fleet.ids):
        changed = (worn.texture[row] != vehicles.texture[row]).any(dim=0)
        if name not in marked:
            assert not changed.any()
            continue
        body = fleet.parts[row] == Part.BODY
        assert float(changed[body].float().mean()) > 0.9
        whole += bool(changed[~body].any())
    # Six of eighteen kinds are laid on paint only; kinds are drawn.
    assert [kind.masked for kind in random_controls._TEXTURES].count(False) == 12
    assert whole == 10
    assert len(marked) == 18
    assert torch.equal(dress(vehicles).texture, worn.texture)
    pair = fleet.batch([marked[0], marked[0]])
    first, second = dress(pair).texture
    assert not torch.equal(first, second)
    others = dress(fleet.batch([marked[0], marked[1]])).texture
    assert not torch.equal(others[0], first)


def test_shapes_are_pushed_out_whatever_the_coat_each_by_its_own_map() -> None:
    fleet = _varied(shapes=0.5)
    plain = _varied()
    # Shapes are drawn last, so that a fleet with them is otherwise the one without.
    assert torch.equal(fleet.textures, plain.textures)
    assert torch.equal(fleet.vertices, plain.vertices)
    worn = wear_random_shapes(fleet, generator=_generator(5))
    shaped = [name for name in fleet.ids if fleet.sources.get(name, {}).get("shape") == "random"]
    assert len(shaped) == 12
    assert {_coat(fleet, name) for name in shaped} > {"catalogue", "patterned"}
    farthest = []
    for row, name in enumerate(fleet.ids):
        moved = (worn.vertices[row] - fleet.vertices[row]).norm(dim=1)
        if name not in shaped:
            assert not moved.any()
            continue
        width_m = fleet.sizes_m[name][1]
        farthest.append(float(moved.max()) / width_m)
        # As in R-S-O some vertices stay nearly where they are.
        assert float(moved.median()) < 0.8 * float(moved.max())
    assert min(farthest) > 0.05
    assert max(farthest) <= 0.5
    assert len(set(farthest)) == len(farthest)


def test_shares_above_one_are_refused_in_one_sentence() -> None:
    with pytest.raises(ConfigurationError, match=r"at most 1, got 1\.25; lower some"):
        PaintVariety(plain=0.5, two_tone=0.25, livery=0.25, patterned=0.25)
    with pytest.raises(ConfigurationError, match="plain"):
        PaintVariety(plain=-0.1)
