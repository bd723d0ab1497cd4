"""The steps that only a reproduction has."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.errors import RunFolderError
from skyproof.main import run
from skyproof.reproduction.step_commands import STEPS, Features, Looks
from skyproof.reproduction.stored_features import read_features
from skyproof.reproduction.stored_looks import read_looks


def test_textures_are_measured_and_samples_drawn(finished: Path, tmp_path: Path) -> None:
    names = ["T-U", "T-PixFcMa", "R-U-0", "R-U-1"]
    out = tmp_path / "looks"
    command = Looks(
        out=out,
        original=finished / "datasets/test",
        camouflages=tuple(finished / "camouflages" / name for name in names),
        backgrounds=finished / "backgrounds",
        fleet=finished / "fleets/test",
    )
    command.run()
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
    with pytest.raises(RunFolderError, match="looks exists"):
        command.run()


def test_features_are_stored_of_what_is_asked_for(finished: Path, tmp_path: Path) -> None:
    command = Features(
        detectors=tuple(sorted((finished / "detectors").iterdir())),
        out=tmp_path / "features.parquet",
        original=finished / "datasets/test",
        camouflages=(finished / "camouflages/R-U-0", finished / "camouflages/T-U"),
        backgrounds=finished / "backgrounds",
        fleet=finished / "fleets/test",
        device="cpu",
    )
    command.run()
    found = read_features(command.out)
    shown = ("ground", "original", "R-U-0", "T-U")
    assert [each.shown for each in found] == [*shown] * len(command.detectors)
    assert {each.scenes[0] for each in found} == {found[0].scenes[0]}
    with pytest.raises(RunFolderError, match="exists already"):
        command.run()


def test_steps_stand_on_a_command_line_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["x", "report", "--out", str(tmp_path)])
    assert run(commands={"": STEPS}) == 2
    assert "holds no scores" in capsys.readouterr().err
    assert run(["score"], commands={"": STEPS}) == 2
    assert "expected one of scenes, looks, features, report" in capsys.readouterr().err
