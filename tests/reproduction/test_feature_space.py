"""Where camouflaged vehicles lie among features, with classes whose places are known."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from skyproof.reproduction.features import embed
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.stored import Features, write_features
from tests.reproduction.fabricate import write_scores

TILES = 12
CHANNELS = 16
ALONG = {"ground": 1.0, "original": 0.0, "T-U-0": 0.75, "R-U-0": 0.1, "R-U_plain": 0.0}


def classes(rng, along, *, per_tile=4, noise=0.5, spread=0.0, detector="retinanet"):
    """Boxes around places on a line through all channels; each tile moves all its boxes alike."""
    shift = spread * rng.normal(size=(TILES, CHANNELS))
    count = TILES * per_tile
    scenes = [f"s{row}" for row in range(count)]
    tiles = [f"tile-{row // per_tile}" for row in range(count)]
    found = {}
    for name, place in along.items():
        vectors = np.repeat(shift, per_tile, axis=0) + noise * rng.normal(size=(count, CHANNELS))
        found[name] = Features(detector, name, scenes, tiles, [0] * count, 4 * place + vectors)
    return found


def embedded(stored):
    """Rows by class, and the points."""
    numbers, points = embed(stored)
    return {row["shown"]: row for row in numbers}, points


def test_places_between_vehicles_and_ground(rng):
    found, points = embedded(classes(rng, ALONG, noise=0.3))
    assert list(found) == [*ALONG, "all"]
    ground, original, learnt, _, plain, together = found.values()
    assert "along" not in ground
    assert original["aside"] is None
    assert learnt["along"] == pytest.approx(0.75, abs=0.03)
    assert learnt["along_low"] < 0.75 < learnt["along_high"]
    assert learnt["aside"] < 0.1
    assert learnt["nearer_ground"] == ground["nearer_ground"] == 100
    assert plain["nearer_ground"] == original["nearer_ground"] == 0
    # Far from all others: by itself. The plain paint is told from the original by chance alone.
    assert learnt["silhouette"] > 0.4
    assert learnt["nearest_own"] == 100
    assert plain["silhouette"] < 0.1
    assert plain["nearest_own"] < 80
    assert 95 < together["pca_share"] <= 100
    assert len(points) == 5 * TILES * 4
    assert together["nearest_own"] == np.mean([found[name]["nearest_own"] for name in ALONG])


def test_off_the_way_is_told(rng):
    stored = classes(rng, {"ground": 1.0, "original": 0.0, "T-U": 0.5}, noise=0.1)
    # Half along the way, and as far off it as the way is long.
    off = np.tile([1.0, -1.0], CHANNELS // 2)
    moved = replace(stored["T-U"], vectors=stored["T-U"].vectors + 4 * off)
    found, _ = embedded({**stored, "T-U": moved})
    assert found["T-U"]["along"] == pytest.approx(0.5, abs=0.05)
    assert found["T-U"]["aside"] > 0.5


def test_tiles_are_held_out_whole(rng):
    # Every class stands where it happens to stand on each tile: nothing is to be learnt from other
    # tiles, and all of it from neighbours on the same one.
    stored = {}
    for name in ("ground", "original", "T-U"):
        stored |= classes(rng, {name: 0.0}, noise=0.01, spread=1.0)
    found, _ = embedded(stored)
    assert found["all"]["nearest_own"] < 50


def test_no_class_is_known_apart_where_all_are_alike(rng):
    found, _ = embedded(classes(rng, dict.fromkeys(ALONG, 0.0)))
    assert found["all"]["nearest_own"] == pytest.approx(20, abs=10)
    assert abs(found["all"]["silhouette"]) < 0.05


def test_the_same_points_again(rng):
    made = classes(rng, {"ground": 1.0, "original": 0.0}, per_tile=2)
    assert embed(made) == embed(made)


def write(folder, rng, *, detector="retinanet", names=tuple(ALONG)):
    stored = classes(rng, {name: ALONG[name] for name in names}, detector=detector)
    write_features(folder / "features.parquet", stored.values())


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
