"""`skyproof ground` and `skyproof vehicles` without sources: what they draw and refuse."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from skyproof.cli.ground import Ground
from skyproof.cli.vehicles import Vehicles
from skyproof.errors import ConfigurationError
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.notes import ImageNote
from skyproof.imagery.settings import (
    LabelSettings,
    SourceSettings,
    TilingSettings,
    tiling_for_images,
)
from skyproof.imagery.tiles.tiling import TilingRecord
from skyproof.imagery.words import tiling_words
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from tests.cli.conftest import Skyproof, bytes_of


def test_ground_is_drawn_from_its_seed_and_written_whole(tmp_path, skyproof: Skyproof):
    out = tmp_path / "ground"
    size = ("--tiles", 1, 2, 1, 1, "--tiling.size-px", 160, "--seed", 3)
    assert skyproof("ground", "--out", out, *size).code == 0
    counts = dict(zip(SPLITS, (1, 2, 1, 1), strict=True))
    write_procedural_backgrounds(tmp_path / "reference", counts, 160, seed=3)
    assert bytes_of(out) == bytes_of(tmp_path / "reference")
    skyproof("ground", "--out", out, *size).refused("exists already")
    blurred = ("--blur-sigma-px", "paper")
    assert skyproof("ground", "--out", tmp_path / "even", *size, *blurred).code == 0
    for split in SPLITS:
        drawn = BackgroundSet.open(out).tiles(split)
        for own, tile in zip(
            drawn, BackgroundSet.open(tmp_path / "even").tiles(split), strict=True
        ):
            assert tile.sensor == replace(own.sensor, blur_sigma_px=2.4)


def test_tiles_hold_images_at_any_heading():
    drawn = tiling_for_images(192, gsd_m=0.125, imagery=False)
    assert drawn == TilingSettings(size_px=274 + 112)
    cut = tiling_for_images(192, gsd_m=0.125, imagery=True)
    assert cut == TilingSettings(size_px=411, minimum_px=192)
    assert cut.turning_px == 274


@pytest.mark.parametrize(
    "wrong",
    [
        {"labels": LabelSettings(Path("cars.geojson"))},
        {"source": SourceSettings(0.125)},
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path, wrong):
    with pytest.raises(ConfigurationError, match="no image was named"):
        Ground(tmp_path, **wrong)


def test_fleets_share_no_vehicle_and_come_from_seeds_of_their_own(tmp_path, skyproof: Skyproof):
    out = tmp_path / "fleets"
    assert skyproof("vehicles", "--out", out, "--counts", 2, 1, 1, 2, "--seed", 4).code == 0
    fleets = {split: Fleet.load(out / split) for split in SPLITS}
    numbers = [
        vehicle_id.rpartition("-")[2] for fleet in fleets.values() for vehicle_id in fleet.ids
    ]
    assert numbers == ["0000", "0001", "0002", "0003", "0004", "0005"]
    # The same split of another seed, or of other counts before it, is drawn by itself.
    (tmp_path / "again").mkdir()
    Vehicles(tmp_path / "again" / "fleets", counts=(1, 1, 1, 2), seed=4).run()
    again = Fleet.load(tmp_path / "again" / "fleets" / "test")
    assert torch.equal(again.textures, fleets["test"].textures)
    plain = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(4))
    assert not torch.equal(plain.vertices, fleets["train"].vertices)
    none = ("vehicles", "--out", tmp_path / "none", "--counts", 1, 1, 0, 1)
    skyproof(*none).refused("--counts", "from 1")


def test_only_what_detectors_learn_from_is_out_of_shape(tmp_path):
    Vehicles(tmp_path / "fleets", counts=(3, 2, 2, 2), shapes=1.0).run()
    Vehicles(tmp_path / "usual", counts=(3, 2, 2, 2), shapes=0.0).run()
    for split in SPLITS:
        shaped, usual = (Fleet.load(tmp_path / name / split) for name in ("fleets", "usual"))
        moved = (shaped.vertices != usual.vertices).flatten(1).any(1)
        assert bool(moved.all()) == (split in ("train", "validation"))
        assert bool(moved.any()) == (split in ("train", "validation"))
    # A quarter is the default.
    Vehicles(tmp_path / "default", counts=(8, 1, 1, 1)).run()
    fleet = Fleet.load(tmp_path / "default" / "train")
    assert sum("shape" in source for source in fleet.sources.values()) == 2


def test_fleets_without_other_paints_are_drawn_with_a_note(tmp_path, skyproof: Skyproof):
    shares = ("plain", "two-tone", "livery", "patterned")
    none = [word for share in shares for word in (f"--paints.{share}", 0)]
    counts = ("--counts", 1, 1, 1, 1)
    answer = skyproof("vehicles", "--out", tmp_path / "plain", *counts, *none)
    assert answer.code == 0
    assert "catalogue paints only" in answer.out
    assert "catalogue" not in skyproof("vehicles", "--out", tmp_path / "varied", *counts).out
    skyproof("vehicles", "--out", tmp_path / "much", "--paints.plain", 0.9).refused(
        "at most 1, got 1.35"
    )


def test_equal_notes_on_images_are_told_once():
    counts = {split: {"tiles": 20, "vehicles": 1, "ignored": 2} for split in SPLITS}
    counts["train"]["tiles"] = 1
    notes = [ImageNote(f"{name}.jpg", "too plain: grey") for name in ["a: 1", "b", "c", "d"]]
    notes[2:2] = [ImageNote("e.jpg", "of 4 bands"), "C: sharp", "D: sharp"]
    record = TilingRecord({}, [], {}, counts, empty=1, notes=notes)
    first, second, third, fourth, *rest = tiling_words(record, labelled=True)
    assert first == "  note: 4 images (a: 1.jpg, b.jpg and 2 more): too plain: grey"
    assert second == "  note: e.jpg: of 4 bands"
    assert (third, fourth) == ("  note: C: sharp", "  note: D: sharp")
    assert " ".join(rest[0].split()) == "train 1 tile, 1 vehicle, 2 ignore regions"
    assert rest[-1].startswith("  1 cell left out")
    again = [*tiling_words(record, labelled=True, told={*notes} - {"D: sharp"})]
    assert again == ["  note: D: sharp", *rest]
    many = TilingRecord({}, [], {}, counts, empty=0, notes=[f"note {i}" for i in range(40)])
    assert "  note: 28 more in tiling.json, once tiled" in [*tiling_words(many, labelled=True)]


@pytest.mark.parametrize(("tiles", "told"), [(9, "±33 points"), (12, None), (0, None)])
def test_too_few_test_tiles_for_an_interval_are_told_at_once(tiles, told):
    counts = {split: {"tiles": 5, "vehicles": 0, "ignored": 0} for split in SPLITS}
    counts["test"]["tiles"] = tiles
    record = TilingRecord({}, [], {}, counts, empty=0, notes=[])
    said = "\n".join(tiling_words(record, labelled=False))
    assert ("too few for a useful interval" in said) == (told is not None)
    assert told is None or told in said
