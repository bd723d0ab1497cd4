"""Colours counted by hand, and textures whose likeness is known."""

import pytest
import torch

from skyproof.camouflage.folder import save_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.reproduction.measure_looks import (
    Worn,
    count_colours,
    likeness,
    measure_looks,
    worn_area,
)
from skyproof.vehicles.vehicle import Part
from tests.vehicles.flat_body import flat_bodies

BLACK, RED, DARK_BLUE, GREY = (0, 0, 0), (255, 128, 16), (128, 128, 15), (128, 128, 128)


def colours(*rows):
    """[3, N] bytes."""
    return torch.tensor(rows, dtype=torch.uint8).T


def drawn(seed, size=512):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(3, size, size, generator=generator) * 255).round().byte()


def test_places_in_the_cube_by_hand():
    counts = count_colours("T-U", colours(BLACK, RED, DARK_BLUE, GREY), torch.ones(4))
    # 16 is the first value that is not dark; 240 the first that is bright.
    assert (counts.faces, counts.edges, counts.corners) == (0.75, 0.25, 0.25)
    bright = count_colours("T-U", colours((240, 239, 16), (240, 240, 128)), torch.ones(2))
    assert (bright.faces, bright.edges, bright.corners) == (1.0, 0.5, 0.0)
    red, green, blue = counts.histogram
    assert (red[0], red[8], red[15]) == (0.25, 0.5, 0.25)
    assert (green[0], green[8]) == (0.25, 0.75)
    assert (blue[0], blue[1], blue[8]) == (0.5, 0.25, 0.25)


def test_each_counts_by_its_area():
    counts = count_colours("T-U", colours(BLACK, RED, GREY), torch.tensor([1.0, 2.0, 5.0]))
    assert (counts.faces, counts.edges, counts.corners) == (0.375, 0.125, 0.125)
    assert counts.histogram[0][0] == 0.125
    with pytest.raises(ConfigurationError, match="got none"):
        count_colours("T-U", colours(BLACK), torch.zeros(1))


def test_random_colours_are_where_the_docstring_says():
    counts = count_colours("T-U", drawn(0), torch.ones(512, 512))
    assert counts.faces == pytest.approx(0.322, abs=0.004)
    assert counts.edges == pytest.approx(0.041, abs=0.002)
    assert counts.corners == pytest.approx(0.0018, abs=0.0004)


def test_area_is_of_worn_texels_alone():
    bodies = flat_bodies(1, 1)
    bodies.parts[:, :256] = Part.BODY
    bodies.parts[:, 256:] = Part.UNDERSIDE
    whole = worn_area(bodies, None)
    assert float(whole[256:].sum()) == 0.0
    assert float(whole[16:256].sum()) == pytest.approx(5.12 * 4.80, rel=1e-4)
    # A texel that one of two vehicles wears counts half.
    mask = torch.zeros(2, 512, 512, dtype=torch.bool)
    mask[0, 16:256] = True
    assert float(worn_area(bodies, mask).sum()) == pytest.approx(5.12 * 4.80 / 2, rel=1e-4)


def test_likeness_of_the_same_of_others_and_of_the_opposite():
    area = torch.ones(512, 512)
    first, second = (Worn(drawn(seed).float() / 255, area) for seed in (0, 1))
    assert likeness(first, first) == (pytest.approx(1.0), 0.0)
    correlation, distance = likeness(first, second)
    assert correlation == pytest.approx(0.0, abs=0.01)
    assert distance > 40
    turned = Worn(1 - first.colours, area)
    assert likeness(first, turned)[0] == pytest.approx(-1.0)
    # One channel is the same everywhere: there is nothing to correlate.
    flat = Worn(torch.full((3, 512, 512), 0.5), area)
    assert likeness(first, flat)[0] is None


def test_what_is_alike_coarsely_is_so_once_fine_detail_is_averaged():
    area = torch.ones(512, 512)
    coarse = drawn(5, 128).repeat_interleave(4, 1).repeat_interleave(4, 2)
    first, second = (
        Worn((coarse.float() * 0.5 + drawn(seed).float() * 0.5).byte().float() / 255, area)
        for seed in (0, 1)
    )
    correlation, distance = likeness(first, second)
    seen_correlation, seen_distance = likeness(first.seen(), second.seen())
    assert correlation == pytest.approx(0.5, abs=0.05)
    assert seen_correlation > 0.85
    assert seen_distance < distance


def test_only_what_is_worn_counts():
    area = torch.zeros(512, 512)
    area[:100] = 1.0
    first, second = drawn(0), drawn(1)
    second[:, :100] = first[:, :100]
    assert likeness(Worn(first.float() / 255, area), Worn(second.float() / 255, area))[1] == 0.0
    seen = [Worn(texture.float() / 255, area).seen() for texture in (first, second)]
    assert likeness(*seen)[1] == 0.0


def test_repeats_are_compared_and_as_many_draws_of_their_control(tmp_path):
    names = ["T-Pix-0", "T-Pix-1", "T-Ma-0", "S-O@0.4-0", "R-Pix-0", "R-Pix-1", "R-Pix-2", "R-Ma-0"]
    for seed, name in enumerate(names):
        generator = torch.Generator().manual_seed(seed)
        camouflage = make_camouflage(CamouflageName.parse(name), generator=generator)
        camouflage.finalise()
        save_camouflage(tmp_path / name, camouflage)
    bodies = flat_bodies(1)
    bodies.parts[:] = Part.UNDERSIDE
    bodies.parts[:, 100:200] = Part.BODY
    seen = []
    folders = [tmp_path / name for name in names]
    looks = measure_looks(folders, bodies, lambda *done: seen.append(done))
    assert seen[-1] == (8, 8)
    assert [row.name for row in looks.textures] == [n for n in names if "S-O" not in n]
    assert [(pair.first, pair.second) for pair in looks.pairs] == [
        ("T-Pix-0", "T-Pix-1"),
        ("R-Pix-0", "R-Pix-1"),
    ]
