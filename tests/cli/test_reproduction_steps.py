"""The steps that only a reproduction has."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.errors import RunFolderError
from skyproof.reproduction.gather_features import store_features
from skyproof.reproduction.measure_looks import write_looks
from skyproof.reproduction.stored import read_features, read_looks, read_practicality


def test_textures_are_measured_and_samples_drawn(finished: Path, tmp_path: Path) -> None:
    names = ["T-U", "T-PixFcMa", "R-U-0", "R-U-1"]
    out = tmp_path / "looks"
    asked = {
        "out": out,
        "original": finished / "datasets/test",
        "camouflages": [finished / "camouflages" / name for name in names],
        "finished": [finished / "camouflages" / name for name in names[:2]],
        "backgrounds": finished / "backgrounds",
        "fleet": finished / "fleets/test",
    }
    write_looks(**asked)
    looks = read_looks(out)
    assert looks is not None
    assert [row.name for row in looks.textures] == names
    assert looks.vehicles == len(
        json.loads((finished / "fleets/test/fleet.json").read_text())["ids"]
    )
    assert 0.3 < looks.textures[2].faces < 0.34
    effort = read_practicality(out)
    assert [(str(name), row.score.total) for name, row in effort.items()] == [
        ("T-U", -3),
        ("T-PixFcMa", 3),
    ]
    # One repeat of T-U has nobody to be compared with, so no draws are compared either.
    assert looks.pairs == []
    # Scenes as bare ground, as built, in the first and the last texture; and the sensor's steps.
    assert [strip.label for strip in looks.samples] == ["ground", "as built", "T-U", "T-PixFcMa"]
    assert len(looks.sensor) == 3
    strips = {}
    for strip in (*looks.samples, *looks.sensor):
        with Image.open(out / strip.file) as picture:
            strips[strip.label] = np.asarray(picture.convert("RGB"), dtype=float)
    ground, built, worn = (strips[label] for label in ("ground", "as built", "T-U"))
    assert ground.shape[1] % ground.shape[0] == 0
    changed = np.abs(built - ground).max(axis=-1) > 0
    assert 0.01 < changed.mean() < 0.9
    # A texture changes vehicles and nothing beside them.
    other = np.abs(worn - built).max(axis=-1) > 40
    assert other.any()
    assert not (other & ~changed).any()
    coarse, smooth, soft = (strips[strip.label] for strip in looks.sensor)
    assert np.abs(np.diff(coarse, axis=1)).mean() > np.abs(np.diff(soft, axis=1)).mean()
    assert not np.array_equal(coarse, smooth)
    with pytest.raises(RunFolderError, match="looks exists"):
        write_looks(**asked)


def test_features_are_stored_of_what_is_asked_for(finished: Path, tmp_path: Path) -> None:
    detectors = sorted((finished / "detectors").iterdir())
    asked = {
        "detectors": detectors,
        "out": tmp_path / "features.parquet",
        "original": finished / "datasets/test",
        "camouflages": [finished / "camouflages/R-U-0", finished / "camouflages/T-U"],
        "backgrounds": finished / "backgrounds",
        "fleet": finished / "fleets/test",
        "device": "cpu",
    }
    store_features(**asked)
    found = read_features(tmp_path / "features.parquet")
    shown = ("ground", "original", "R-U-0", "T-U")
    assert [each.shown for each in found] == [*shown] * len(detectors)
    assert {each.scenes[0] for each in found} == {found[0].scenes[0]}
    with pytest.raises(RunFolderError, match="exists already"):
        store_features(**asked)
