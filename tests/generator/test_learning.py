"""From photographs to fleets by the commands, with everything as short as it can be."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.generator.__main__ import COMMANDS
from skyproof.generator.folder import load_generator
from skyproof.generator.learning import Imagery, learn_vehicles
from skyproof.generator.settings import AdversarialSettings, FitSettings, LearnSettings
from skyproof.main import run
from skyproof.scenes.background_index import save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.vehicles.fleet import Fleet
from tests.generator.photographs import Photographs, take_photographs

FIT = FitSettings(bodies=1, candidates=1, choose_steps=1, steps=2)
SETTINGS = LearnSettings(fit=FIT, gan=AdversarialSettings(steps=4, batch_size=2))
# Short fits are bad ones.
LOOSE = 1.0


def shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("skyproof.generator.learning.LARGEST_MISFIT", LOOSE)
    patch.setattr("skyproof.generator.learning.LEAST_VEHICLES", 5)
    patch.setattr("skyproof.generator.sheets._SAMPLES", 2)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


@pytest.fixture(scope="module")
def layered(photographs: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished generator, with the fits of its nine vehicles; not to be changed."""
    folder = tmp_path_factory.mktemp("layered") / "town"
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        learn_vehicles(imagery_of(photographs), SETTINGS, folder)
    return folder


def imagery_of(photographs: Photographs) -> list[Imagery]:
    return [Imagery(photographs.tiles, photographs.cleared)]


def files(folder: Path) -> dict[str, bytes]:
    """What a generator's folder holds, but for how long its steps took."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "steps.jsonl"
    }


@pytest.mark.slow
def test_a_stopped_run_ends_at_the_same_bytes(
    photographs: Photographs, layered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("learning", "adversarial_training"):
        monkeypatch.setattr(f"skyproof.generator.{module}._CHECKPOINT_EVERY", 2)
    settings = replace(SETTINGS, method="gan")
    seen: list[tuple[str, int]] = []

    class Stopped(Exception):
        pass

    def learn(name: str, stop_at: tuple[str, int] | None = None) -> None:
        seen.clear()

        def stop(stage: str, done: int, total: int) -> None:
            seen.append((stage, done))
            if (stage, done) == stop_at:
                raise Stopped

        learn_vehicles(
            imagery_of(photographs),
            settings,
            tmp_path / name,
            progress=stop,
        )

    shutil.copytree(layered / "fits", tmp_path / "whole" / "fits")
    # Fits serve another method.
    learn("whole")
    assert {stage for stage, _ in seen} == {"learn"}
    with pytest.raises(Stopped):
        learn("stopped", ("fit", 4))
    with pytest.raises(Stopped):
        learn("stopped", ("learn", 2))
    assert seen[0] == ("fit", 3)
    learn("stopped")
    assert seen == [("learn", 3), ("learn", 4)]
    assert files(tmp_path / "stopped") == files(tmp_path / "whole")
    found = set(files(tmp_path / "whole"))
    sheets = {"samples.png", "fits/00001.png"}
    assert {"generator.json", "generator.safetensors", *sheets} <= found
    assert load_generator(tmp_path / "whole").method == "gan"


def test_a_finished_run_is_not_done_again(
    photographs: Photographs, layered: Path, tmp_path: Path
) -> None:
    shutil.copytree(layered, tmp_path / "town")

    def learn() -> dict[str, object]:
        return learn_vehicles(imagery_of(photographs), SETTINGS, tmp_path / "town")

    first = learn()
    before = files(tmp_path / "town")
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "town").rglob("*.png")}
    assert learn() == first
    assert files(tmp_path / "town") == before
    assert times == {path: path.stat().st_mtime_ns for path in times}
    other = replace(SETTINGS, seed=1)
    with pytest.raises(RunFolderError, match="other settings"):
        learn_vehicles(imagery_of(photographs), other, tmp_path / "town")


def test_fits_of_other_photographs_under_the_same_names_are_refused(
    photographs: Photographs, layered: Path, tmp_path: Path
) -> None:
    for name, sets in (("tiles", photographs.tiles), ("cleared", photographs.cleared)):
        shutil.copytree(sets.folder, tmp_path / name)

    def learn(name: str) -> None:
        imagery = Imagery(*(BackgroundSet.open(tmp_path / each) for each in ("tiles", "cleared")))
        learn_vehicles([imagery], SETTINGS, tmp_path / name)

    shutil.copytree(layered, tmp_path / "town")
    shutil.copytree(layered / "fits", tmp_path / "fits-only" / "fits")
    # Copies of the same photographs are the same.
    learn("town")
    cleared = BackgroundSet.open(tmp_path / "cleared")
    moved = [
        replace(tile, removed=tuple(replace(each, heading_rad=0.1) for each in tile.removed))
        for tile in cleared.all_tiles()
    ]
    for change in ("heading", "pixels"):
        if change == "heading":
            write_index(cleared.folder, cleared.gsd_m, moved, cleared.sensor, cleared.light)
        else:
            write_index(
                cleared.folder, cleared.gsd_m, cleared.all_tiles(), cleared.sensor, cleared.light
            )
            learn("town")
            tile = photographs.tiles.all_tiles()[0]
            save_tile(tmp_path / "tiles", tile, 255 - photographs.tiles.pixels(tile.id))
        for name in ("town", "fits-only"):
            with pytest.raises(RunFolderError, match="other photographs"):
                learn(name)


def test_photographs_of_two_cameras_are_fitted_with_their_own(
    photographs: Photographs, layered: Path, tmp_path: Path
) -> None:
    other = take_photographs(tmp_path / "other", 2)
    both = [*imagery_of(photographs), Imagery(other.tiles, other.cleared)]
    record = learn_vehicles(both, SETTINGS, tmp_path / "both")
    assert record["vehicles"] == 11
    rows = [
        json.loads(line) for line in (tmp_path / "both/fits/steps.jsonl").read_text().splitlines()
    ]
    first = [json.loads(line) for line in (layered / "fits/steps.jsonl").read_text().splitlines()]
    assert len(first) == 9
    assert [row["misfit"] for row in rows[:9]] == [row["misfit"] for row in first]
    assert [row["misfit"] for row in rows[9:]] != [row["misfit"] for row in first[:2]]


def test_no_photographs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="expects photographs, got none"):
        learn_vehicles([], SETTINGS, tmp_path / "town")


def test_photographs_of_another_resolution_are_refused(
    photographs: Photographs, tmp_path: Path
) -> None:
    other = take_photographs(tmp_path / "other", 6)
    other.tiles.gsd_m = 0.25
    with pytest.raises(ConfigurationError, match=r"has 0.25 m per pixel and .* 0.125; cut both"):
        learn_vehicles(
            [*imagery_of(photographs), Imagery(other.tiles, other.cleared)],
            SETTINGS,
            tmp_path / "town",
        )


def test_too_few_vehicles_are_refused(
    photographs: Photographs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyproof.generator.learning.LEAST_VEHICLES", 50)
    with pytest.raises(ConfigurationError, match="at least 50 that can be fitted, got 9"):
        learn_vehicles(imagery_of(photographs), SETTINGS, tmp_path / "town")
    assert not (tmp_path / "town").exists()


def test_bad_fits_are_dropped_and_counted(
    photographs: Photographs, layered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(layered / "fits", tmp_path / "town" / "fits")
    monkeypatch.setattr("skyproof.generator.learning.LARGEST_MISFIT", 0.0)
    with pytest.raises(ConfigurationError, match=r"got 0 .*left out: 9 because its fit is off"):
        learn_vehicles(imagery_of(photographs), SETTINGS, tmp_path / "town")


def test_the_commands_lead_from_photographs_to_fleets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    take_photographs(tmp_path, 6)
    fit = ["bodies", "1", "candidates", "1", "choose-steps", "1", "steps", "1"]
    options = [
        f"--settings.fit.{word}" if index % 2 == 0 else word for index, word in enumerate(fit)
    ]
    learn = ["learn", str(tmp_path / "tiles"), str(tmp_path / "cleared")]
    assert run([*learn, "--out", str(tmp_path / "town"), *options], commands=COMMANDS) == 0
    said = capsys.readouterr().out
    assert "Learnt from 6 vehicles" in said
    assert "Headings of 6 were estimated" in said
    assert "--fleets" in said
    draw = ["learn", "--out", str(tmp_path / "town"), "--counts", "4", "2", "2", "2"]
    assert run([*draw, "--fleets", str(tmp_path / "fleets")], commands=COMMANDS) == 0
    fleet = Fleet.load(tmp_path / "fleets" / "train")
    assert len(fleet) == 4
    assert all(source["generator"] == "layered" for source in fleet.sources.values())
    # They can be mixed with drawn ones.
    assert fleet.ids[0].endswith("-5000")
    mixed, drawn = str(tmp_path / "mixed"), str(tmp_path / "drawn")
    assert run(["vehicles", "--counts", "4", "1", "1", "1", "--out", drawn]) == 0
    both = [f"{drawn}/train", str(tmp_path / "fleets" / "train")]
    assert run(["vehicles", *both, "--out", mixed]) == 0
    assert len(Fleet.load(Path(mixed))) == 8
    # With the photographs it is the same call, and nothing is learnt anew.
    again = [*learn, *options, *draw[1:], "--fleets", str(tmp_path / "again")]
    assert run(again, commands=COMMANDS) == 0
    assert torch.equal(Fleet.load(tmp_path / "again" / "train").textures, fleet.textures)
    assert run([*draw, "--fleets", str(tmp_path / "again")], commands=COMMANDS) == 2
    assert "exists already" in capsys.readouterr().err
