"""Palettes from the ground, and CIELAB."""

import json

import pytest
import torch

from skyproof.camouflage.palette import fit_palette, ground_palette, load_palette
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.ground.procedural import write_procedural_backgrounds

CLUSTERS = torch.tensor([[40, 60, 30], [90, 80, 70], [160, 150, 140], [220, 60, 40], [30, 40, 160]])


def ground(counts=(500, 400, 300, 200, 100)):
    """Five narrow clusters of colours, of known sizes."""
    generator = torch.Generator().manual_seed(0)
    rows = CLUSTERS.repeat_interleave(torch.tensor(counts), dim=0).float()
    return ((rows + torch.randint(-3, 4, rows.shape, generator=generator)) / 255)[
        torch.randperm(len(rows), generator=generator)
    ]


@pytest.mark.parametrize(
    ("srgb", "cielab"),
    [
        # Published values for D65: white, mid grey, the three primaries.
        ((255, 255, 255), (100.0, 0.0, 0.0)),
        ((119, 119, 119), (50.03, 0.0, 0.0)),
        ((255, 0, 0), (53.24, 80.09, 67.20)),
        ((0, 255, 0), (87.73, -86.18, 83.18)),
        ((0, 0, 255), (32.30, 79.19, -107.86)),
        ((0, 0, 0), (0.0, 0.0, 0.0)),
    ],
)
def test_cielab_of_known_colours_and_back(srgb, cielab):
    colour = torch.tensor(srgb, dtype=torch.float64) / 255
    assert torch.allclose(
        srgb_to_cielab(colour), torch.tensor(cielab, dtype=torch.float64), atol=0.02
    )
    assert torch.allclose(cielab_to_srgb(srgb_to_cielab(colour)), colour, atol=1e-6)


def test_the_palette_is_the_grounds_clusters_most_frequent_first():
    palette = fit_palette(ground(), 5)
    assert palette.shape == (5, 3)
    assert (palette * 255 - CLUSTERS).abs().max() <= 1.0
    assert torch.equal((palette * 255).round() / 255, palette)


def test_the_same_pixels_give_one_palette():
    pixels = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(fit_palette(pixels, 5), fit_palette(pixels, 5))


def test_colours_that_look_alike_share_a_cluster():
    """Two greens are farther apart in sRGB than two dark colours, yet nearer to the eye."""
    rows = torch.tensor([[0, 235, 0], [0, 255, 40], [0, 0, 0], [0, 0, 60]]).repeat(50, 1) / 255
    palette = fit_palette(rows.float(), 3)
    assert float((palette - torch.tensor([0.0, 0.0, 60 / 255])).abs().sum(1).min()) < 0.01


def test_ground_of_many_tiles_is_seen_in_fewer_pixels_each(tmp_path, monkeypatch):
    backgrounds = write_procedural_backgrounds(tmp_path / "ground", {"attack": 3}, 140, seed=0)
    monkeypatch.setattr("skyproof.camouflage.palette._PIXELS", 100)
    seen = []

    def fit(pixels, colours):
        seen.append(len(pixels))
        return fit_palette(pixels, colours)

    monkeypatch.setattr("skyproof.camouflage.palette.fit_palette", fit)
    assert ground_palette(backgrounds, 3).shape == (3, 3)
    assert seen == [3 * 34]


def test_the_palette_of_the_ground_is_that_of_the_attack_split(tmp_path):
    splits = {"attack": 2, "test": 1}
    backgrounds = write_procedural_backgrounds(tmp_path / "ground", splits, 140, seed=0)
    palette = ground_palette(backgrounds, 3)
    assert torch.equal(ground_palette(backgrounds, 3), palette)
    means = torch.stack(
        [backgrounds.pixels(t.id).float().mean((1, 2)) / 255 for t in backgrounds.tiles("attack")]
    )
    assert palette.shape == (3, 3)
    # The middle of the ground lies among its colours.
    assert (palette.amin(0) <= means.mean(0)).all()
    assert (palette.amax(0) >= means.mean(0)).all()


def test_a_palette_file_reads_back(tmp_path):
    palette = fit_palette(ground(), 5)
    rows = (palette * 255).round().int().tolist()
    (tmp_path / "palette.json").write_text(json.dumps({"colours_srgb": rows}))
    assert torch.equal(load_palette(tmp_path / "palette.json"), palette)


def test_too_few_colours_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="its pixels have 1"):
        fit_palette(torch.full((100, 3), 0.5), 5)
    path = tmp_path / "one.json"
    path.write_text('{"colours_srgb": [[1, 2, 3]]}')
    with pytest.raises(StoredFileError, match="length >= 2"):
        load_palette(path)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"colours": []}',
        '{"colours_srgb": [[1, 2], [3, 4]]}',
        '{"colours_srgb": [[0, 0, 0], [1, 2, 256]]}',
    ],
)
def test_another_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "palette.json").write_text(text)
    with pytest.raises(StoredFileError, match=r"palette\.json"):
        load_palette(tmp_path / "palette.json")
