"""`skyproof score` without detectors: what camouflages look like, measured and not judged."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from skyproof.results.looks import read_looks
from tests.cli.conftest import Skyproof


def test_textures_are_measured_without_a_detector(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    names = ["T-U", "T-PixFcMa", "R-U-0", "R-U-1"]
    out = tmp_path / "looks"
    given = ["score", "--camouflages", *(finished / "camouflages" / name for name in names)]
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test"]
    words = [*given, *world, "--original", finished / "datasets/test", "--out", out]
    answer = skyproof(*words)
    assert answer.code == 0, answer.err
    assert "Looks of 4 camouflages" in answer.out
    looks = read_looks(out)
    assert looks is not None
    assert [row.name for row in looks.textures] == names
    assert looks.vehicles == len(
        json.loads((finished / "fleets/test/fleet.json").read_text())["ids"]
    )
    assert 0.3 < looks.textures[2].faces < 0.34
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
    skyproof(*words).refused("looks")


def test_what_cannot_be_looked_at_is_refused(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    out = ("--out", tmp_path / "looks")
    skyproof("score", *out).refused("expects --detectors", "--camouflages")
    skyproof("score", *out, "--frames", f"{finished}@0.125").refused("expects --detectors")
    worn = ("--camouflages", finished / "camouflages/T-U")
    skyproof("score", *out, *worn).refused("--original")
    skyproof("score", *out, *worn, "--original", finished / "datasets/test").refused("--fleet")
