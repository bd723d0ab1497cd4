"""Where camouflaged vehicles lie among features, with classes whose places are known."""

import csv

import numpy as np
import pytest

from skyproof.reproduction.feature_space import embed
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.stored_features import Features, write_features
from tests.reproduction.fabricate import write_scores

TILES = 12
CHANNELS = 16
ALONG = {"ground": 1.0, "original": 0.0, "T-U-0": 0.75, "R-U-0": 0.1, "R-U_plain": 0.0}


def classes(rng, along, *, per_tile=4, noise=0.5, spread=0.0):
    """Boxes around places on a line through all channels; each tile moves all its boxes alike."""
    shift = spread * rng.normal(size=(TILES, CHANNELS))
    vectors = {
        name: 4 * place
        + np.repeat(shift, per_tile, axis=0)
        + noise * rng.normal(size=(TILES * per_tile, CHANNELS))
        for name, place in along.items()
    }
    tiles = {
        name: [f"tile-{row // per_tile}" for row in range(len(vectors[name]))] for name in along
    }
    return vectors, tiles


def test_places_between_vehicles_and_ground(rng):
    found = embed(*classes(rng, ALONG, noise=0.3))
    ground, original, learnt, _, plain = found.shown
    assert found.classes == list(ALONG)
    assert ground.along is None
    assert original.aside is None
    assert learnt.along.estimate == pytest.approx(0.75, abs=0.03)
    assert learnt.along.low < 0.75 < learnt.along.high
    assert learnt.aside < 0.1
    assert learnt.nearer_ground.estimate == ground.nearer_ground.estimate == 1
    assert plain.nearer_ground.estimate == original.nearer_ground.estimate == 0
    # Far from all others: by itself. The plain paint is told from the original by chance alone.
    assert learnt.silhouette > 0.4
    assert learnt.nearest_own.estimate == 1
    assert plain.silhouette < 0.1
    assert plain.nearest_own.estimate < 0.8
    assert 0.95 < found.pca_share <= 1
    assert found.pca.shape == found.tsne.shape == (5 * TILES * 4, 2)
    assert found.nearest_own == np.mean([each.nearest_own.estimate for each in found.shown])


def test_off_the_way_is_told(rng):
    vectors, tiles = classes(rng, {"ground": 1.0, "original": 0.0, "T-U": 0.5}, noise=0.1)
    # Half along the way, and as far off it as the way is long.
    off = np.tile([1.0, -1.0], CHANNELS // 2)
    found = embed({**vectors, "T-U": vectors["T-U"] + 4 * off}, tiles)
    along = found.shown[2].along.estimate
    assert along == pytest.approx(0.5, abs=0.05)
    assert found.shown[2].aside > 0.5


def test_tiles_are_held_out_whole(rng):
    # Every class stands where it happens to stand on each tile: nothing is to be learnt from other
    # tiles, and all of it from neighbours on the same one.
    vectors, tiles = {}, {}
    for name in ("ground", "original", "T-U"):
        made, places = classes(rng, {name: 0.0}, noise=0.01, spread=1.0)
        vectors |= made
        tiles |= places
    found = embed(vectors, tiles)
    assert found.nearest_own < 0.5


def test_no_class_is_known_apart_where_all_are_alike(rng):
    found = embed(*classes(rng, dict.fromkeys(ALONG, 0.0)))
    assert found.nearest_own == pytest.approx(0.2, abs=0.1)
    assert abs(found.silhouette) < 0.05


def test_the_same_points_again(rng):
    made = classes(rng, {"ground": 1.0, "original": 0.0}, per_tile=2)
    first = embed(*made)
    second = embed(*made)
    assert np.array_equal(first.tsne, second.tsne)
    assert np.array_equal(first.pca, second.pca)


def write(folder, rng, *, detector="retinanet", names=tuple(ALONG)):
    vectors, tiles = classes(rng, {name: ALONG[name] for name in names})
    every = []
    for name in names:
        count = len(vectors[name])
        scenes = [f"s{row}" for row in range(count)]
        every.append(Features(detector, name, scenes, tiles[name], [0] * count, vectors[name]))
    write_features(folder / "features.parquet", every)


@pytest.fixture
def folder(tmp_path):
    """A run that can be set beside the paper; one detector of two shows its features."""
    write_scores(
        tmp_path / "scores" / "000", {"T-U-0": 0.8, "T-Pix-0": 0.7, "T-Fc-0": 0.3, "R-U-0": 0.1}
    )
    write_scores(tmp_path / "scores" / "001", {"R-U_plain": 0.1})
    return tmp_path


def rows(folder, name):
    with open(folder / "tables" / name, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_report_shows_them(folder, rng):
    write(folder, rng, names=("ground", "original", "R-U_plain", "T-U-0", "R-U-0"))
    write_reproduction_report(folder)
    found = {row["shown"]: row for row in rows(folder, "embeddings.csv")}
    assert list(found) == ["ground", "original", "T-U", "R-U", "R-U_plain", "all"]
    assert [row["boxes"] for row in found.values()] == ["48"] * 5 + ["240"]
    assert float(found["T-U"]["nearer_ground"]) > 90
    assert found["ground"]["along"] == "–"
    points = rows(folder, "embedding_points.csv")
    assert len(points) == 240
    assert {row["shown"] for row in points} == {*found} - {"all"}
    page = (folder / "tables" / "README.md").read_text()
    assert "What the detectors’ features show" in page
    assert "| T-U | RetinaNet | best plain paint (R-U_plain) | 48 |" in page
    assert "Of YOLOv5 no features are stored" in page
    assert (folder / "tables" / "embeddings.png").stat().st_size > 10_000
    assert "Features at vehicles and at ground" in (folder / "report.html").read_text()


def test_runs_of_before_have_no_such_section(folder):
    write_reproduction_report(folder)
    assert "features show" not in (folder / "tables" / "README.md").read_text()
    assert not list((folder / "tables").glob("embedding*"))


def test_too_little_is_not_shown(folder, rng):
    # No learnt camouflage: nothing to ask about.
    write(folder, rng, names=("ground", "original", "R-U-0"))
    write_reproduction_report(folder)
    assert not list((folder / "tables").glob("embedding*"))
