"""Physics-based images from the command line, and two renderers kept apart."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from skyproof.cycles import blender as blender_module
from skyproof.cycles.blender import find_blender
from skyproof.errors import ConfigurationError
from tests.cli.conftest import Skyproof, bytes_of
from tests.expert_options import PROGRAM

CPU = ["--device", "cpu"]
ROOT = Path(__file__).parents[2]
CYCLES = ["--renderer", "cycles", "--cycles.samples", 1]


@pytest.fixture(scope="session")
def blender() -> Path:
    try:
        return find_blender().path
    except ConfigurationError as missing:
        pytest.skip(str(missing))


@pytest.fixture
def no_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    monkeypatch.setattr(
        blender_module, "__file__", str(tmp_path / "checkout/src/skyproof/cycles/blender.py")
    )


def ground_and_fleet(folder: Path) -> list[object]:
    ground = ["--backgrounds", folder / "backgrounds"]
    return [*ground, "--fleet", folder / "fleets/test", *CPU]


def world(folder: Path) -> list[object]:
    return ["--scenes", folder / "scenes/test.jsonl", *ground_and_fleet(folder)]


def rewritten(folder: Path, renderer: str) -> None:
    """Has a dataset say that another renderer made it."""
    path = folder / "annotations.json"
    document = json.loads(path.read_text())
    document["info"]["renderer"] = renderer
    path.write_text(json.dumps(document))


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_the_same_layout_and_labels(
    finished: Path, worn: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "drawn"
    call = [
        "render",
        *world(finished),
        "--out",
        out,
        "--camouflage",
        finished / "camouflages/T-U",
        *CYCLES,
    ]
    answer = skyproof(*call, "--workers", 2)
    assert answer.code == 0, answer.err
    drawn, other = bytes_of(out), bytes_of(worn / "test-T-U")
    assert drawn.keys() == other.keys()
    same = {name for name in drawn if drawn[name] == other[name]}
    assert same == {"scenes.jsonl"}
    labels, others = (json.loads(each["annotations.json"]) for each in (drawn, other))
    info, other_info = labels.pop("info"), others.pop("info")
    assert labels == others
    assert (info["renderer"], other_info["renderer"]) == ("cycles", "torch")
    assert info["rendering"]["samples"] == 1
    assert info["rendering"]["blender"].startswith("4.5.")
    skyproof(*call).refused(str(out), "not overwritten")
    assert bytes_of(out) == drawn
    assert [path.name for path in tmp_path.iterdir()] == ["drawn"]


@pytest.mark.usefixtures("no_blender")
def test_without_blender_nothing_is_written(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    call = ["render", *world(finished), "--out", tmp_path / "out/drawn", *CYCLES]
    skyproof(*call).refused("need Blender 4.5 LTS", "make blender")
    missing = tmp_path / "missing"
    skyproof(*call, "--blender", missing).refused(str(missing), "is no file")
    skyproof(*call, "--blender", sys.executable).refused(
        sys.executable, "neither Blender nor a Python"
    )
    assert not (tmp_path / "out").exists()
    scored = [
        "score",
        "--detectors",
        finished / "detectors/retinanet",
        "--camouflages",
        finished / "camouflages/T-U",
    ]
    original = tmp_path / "original"
    original.mkdir()
    for name in ("annotations.json", "scenes.jsonl"):
        (original / name).write_bytes((finished / "datasets/test" / name).read_bytes())
    rewritten(original, "cycles")
    scored += [
        *ground_and_fleet(finished),
        "--original",
        original,
        "--out",
        tmp_path / "scores",
        *CYCLES,
    ]
    skyproof(*scored).refused("need Blender 4.5 LTS")
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "original"}


def test_choices_that_there_are_not(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    for wrong in (["--renderer", "povray"], ["--renderer", "cycles", "--cycles.finish", "shiny"]):
        answer = skyproof("render", *world(finished), "--out", tmp_path / "x", *wrong)
        assert answer.code == 2
        assert wrong[-1] in answer.err
        assert "Traceback" not in answer.err
    assert not (tmp_path / "x").exists()


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_numbers_that_cannot_work(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    for wrong in (["--workers", 0], ["--cycles.samples", 0]):
        skyproof("render", *world(finished), "--out", tmp_path / "x", *CYCLES, *wrong).refused(
            wrong[0]
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.blender
def test_killed_in_the_middle(
    finished: Path, tmp_path: Path, skyproof: Skyproof, blender: Path
) -> None:
    """The same command goes on with the crops that are not there yet, to the same images."""
    asked = tmp_path / "asked"
    asked.touch()
    # Notes every line that a worker gets: the job and the name of its result.
    listener = tmp_path / "python"
    listener.write_text(
        "#!/bin/sh\n"
        f'case "$1" in *worker.py) tee -a {asked} | {blender} "$@";; '
        f'*) exec {blender} "$@";; esac\n'
    )
    listener.chmod(0o755)
    some = tmp_path / "some.jsonl"
    some.write_text(
        "".join((finished / "scenes/test.jsonl").read_text().splitlines(keepends=True)[:3])
    )
    drawing = ["render", *world(finished)]
    drawing[drawing.index("--scenes") + 1] = some
    out = tmp_path / "drawn"
    call = [
        *map(str, [*drawing, "--out", out, *CYCLES]),
        *("--blender", str(listener), "--workers", "1"),
    ]
    first = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *call],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    crops, until = tmp_path / ".drawn.crops", time.monotonic() + 120
    while len(list(crops.glob("[!.]*.npy"))) < 2 and time.monotonic() < until:
        time.sleep(0.005)
    first.send_signal(signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    assert not out.exists()
    time.sleep(1.0)  # the process that was left behind ends the crop it was at, and then itself
    kept = {path.name for path in crops.glob("[!.]*.npy")}
    assert len(kept) >= 2
    asked.write_text("")
    answer = skyproof(*call)
    assert answer.code == 0, answer.err
    again = [Path(line.split("\t")[1]).name for line in asked.read_text().splitlines()]
    assert again
    assert not kept & set(again)
    assert len(set(again)) == len(again)
    assert not crops.exists()
    assert skyproof(*drawing, "--out", tmp_path / "whole", *CYCLES).code == 0
    assert bytes_of(out) == bytes_of(tmp_path / "whole")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_score_refuses_an_original_of_the_other_renderer(
    finished: Path, tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(*arguments: object, **options: object) -> None:
        raise AssertionError("rendered before it was refused")

    monkeypatch.setattr("skyproof.render.dataset.render_dataset", render)
    original = finished / "datasets/test"
    answer = skyproof(
        *(
            "score",
            "--detectors",
            finished / "detectors/retinanet",
            "--camouflages",
            finished / "camouflages/T-U",
        ),
        *(
            *ground_and_fleet(finished),
            "--original",
            original,
            "--out",
            tmp_path / "scores/all",
            *CYCLES,
        ),
    )
    answer.refused(str(original), "torch", "cycles", "--renderer")
    assert not list(tmp_path.iterdir())


def test_score_refuses_before_it_renders(
    copied: Callable[..., Path], tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(*arguments: object, **options: object) -> None:
        raise AssertionError("rendered before it was refused")

    monkeypatch.setattr("skyproof.render.dataset.render_dataset", render)
    folder = copied()
    original, there = folder / "datasets/test", tmp_path / "scores"
    call = [
        "score",
        "--detectors",
        folder / "detectors/retinanet",
        "--camouflages",
        folder / "camouflages/T-U",
    ]
    call += [*ground_and_fleet(folder), "--original", original, *CPU, "--out"]
    there.mkdir()
    skyproof(*call, there).refused(str(there), "exists")
    path = original / "annotations.json"
    document = json.loads(path.read_text())
    document["info"]["rendering"]["blur_sigma_px"] = 1.0
    path.write_text(json.dumps(document))
    skyproof(*call, tmp_path / "new").refused(str(original), "other settings")
    assert sorted(path.name for path in tmp_path.iterdir() if path != folder) == ["scores"]


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_a_score_stopped_while_judging_draws_nothing_again(
    finished: Path, tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, out = tmp_path / "original", tmp_path / "scores"
    assert skyproof("render", *world(finished), "--out", original, *CYCLES).code == 0
    call = [
        "score",
        "--detectors",
        finished / "detectors/retinanet",
        "--camouflages",
        finished / "camouflages/T-U",
    ]
    call += [
        *ground_and_fleet(finished),
        "--original",
        original,
        "--out",
        out,
        *CYCLES,
        "--workers",
        1,
    ]

    def stop(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(import_module("skyproof.measure.score"), "write_outcomes", stop)
        assert skyproof(*call).code == 130

    def render(*arguments: object) -> None:
        raise AssertionError("drawn again")

    monkeypatch.setattr("skyproof.cycles.workers.Workers._render", render)
    answer = skyproof(*call)
    assert answer.code == 0, answer.err
    assert {path.name for path in tmp_path.iterdir()} == {"original", "scores"}


def test_vehicles_marked_so_wear_patterns(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    fleet = tmp_path / "fleet"
    shutil.copytree(finished / "fleets/test", fleet)
    stored = json.loads((fleet / "fleet.json").read_text())
    stored["sources"] = {name: {"coat": "patterned"} for name in stored["ids"]}
    (fleet / "fleet.json").write_text(json.dumps(stored))
    drawn = {}
    for name, vehicles in (("own", finished / "fleets/test"), ("worn", fleet), ("again", fleet)):
        ground = ["--backgrounds", finished / "backgrounds", "--fleet", vehicles, *CPU]
        call = ["render", "--scenes", finished / "scenes/test.jsonl", *ground]
        assert skyproof(*call, "--out", tmp_path / name).code == 0
        drawn[name] = bytes_of(tmp_path / name)
    changed = {path for path in drawn["own"] if drawn["own"][path] != drawn["worn"][path]}
    assert changed
    assert all(path.startswith("images/") for path in changed)
    assert drawn["again"] == drawn["worn"]
