"""The demo from nothing to a report, and what a second call does."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from skyproof.cli.stages import render_folder
from skyproof.errors import ConfigurationError
from skyproof.files import read_json, write_json
from skyproof.plans import demo
from tests.cli.conftest import TINY, Skyproof, bytes_of

# The second render is a stand-in: the differentiable renderer, whose images say that Cycles drew them.
CYCLES = ("test-cycles", "test-cycles-R-U-0", "test-cycles-R-U-1", "test-cycles-T-U")

KEYS = {
    "camouflage", "renderer", "detector", "vehicles", "easr", "easr_low", "easr_high", "net_easr", "net_easr_low",
    "net_easr_high", "asr", "er", "ap_original", "ap_adversarial", "apd", "match",
}  # fmt: skip


def test_run_folder_holds_results_and_report(finished: Path) -> None:
    rows = json.loads((finished / "results.json").read_text())["rows"]
    assert {row["match"] for row in rows} == {"centre_1m", "iou_50"}
    assert {row["camouflage"] for row in rows} == {"T-U", "R-U"}
    for row in rows:
        assert row.keys() >= KEYS
        assert (row["renderer"], row["detector"]) == ("torch", "retinanet")
        assert row["vehicles"] > 0
    page = (finished / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    environment = json.loads((finished / "environment.json").read_text())
    assert environment["device"] == "cpu"
    assert environment["finished"]
    assert {row["stage"] for row in json.loads((finished / "timings.json").read_text())} >= {
        "render",
        "evaluate",
    }


def test_second_call_changes_nothing(finished: Path, skyproof: Skyproof) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    contents = bytes_of(finished)
    for extra in ([], ["--device", "auto"]):
        answer = skyproof("demo", "--out", finished, *TINY, *extra)
        assert answer.code == 0
        assert "finished" in answer.out
        assert str(finished / "report.html") in answer.out.replace("\n", "")
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before
    assert bytes_of(finished) == contents


def test_other_settings_are_refused_and_named(finished: Path, skyproof: Skyproof) -> None:
    contents = bytes_of(finished)
    frames = finished / "nowhere@0.1"
    for flags, name in (
        (["--seed", 1], "seed"),
        (["--attack.steps", 5], "attack"),
        (["--imagery", "/some/orthophoto.tif"], "imagery"),
        (["--frames", frames], "frames"),
        (["--gsd", 0.2], "gsd"),
    ):
        skyproof("demo", "--out", finished, *TINY, *flags).refused(
            str(finished), f"({name})", "another --out"
        )
    assert bytes_of(finished) == contents


def test_a_detector_that_finds_nothing_without_camouflage_is_refused(
    copied, skyproof: Skyproof
) -> None:
    """A threshold above every score: no vehicle is found before the camouflage, so there is no success rate."""
    folder = copied("evaluation", "report.html", "results.json")
    card = folder / "detectors" / "retinanet" / "detector.json"
    good = card.read_text()
    card.write_text(json.dumps({**json.loads(good), "threshold": 1.0}))
    skyproof("demo", "--out", folder, *TINY).refused(
        "retinanet finds none of the", "threshold of 1"
    )
    assert not (folder / "evaluation").exists()
    card.write_text(good)
    assert skyproof("demo", "--out", folder, *TINY).code == 0


def test_no_random_control_is_possible(tmp_path: Path, skyproof: Skyproof) -> None:
    answer = skyproof(
        "demo",
        "--out",
        tmp_path / "run",
        *TINY,
        "--sizes.random-draws",
        0,
        "--sizes.test-images",
        2,
    )
    assert answer.code == 0, answer.err
    rows = json.loads((tmp_path / "run" / "results.json").read_text())["rows"]
    assert {row["camouflage"] for row in rows} == {"T-U"}
    assert all(row["net_easr"] is None for row in rows)


def test_every_stage_is_announced_without_a_terminal(copied, skyproof: Skyproof) -> None:
    folder = copied("datasets/test-T-U", "evaluation", "report.html")
    answer = skyproof("demo", "--out", folder, *TINY)
    assert answer.code == 0
    for stage in ("render test-T-U", "evaluate"):
        assert f"{stage} ..." in answer.out
        assert f"{stage}: done in" in answer.out
    assert "train retinanet ..." not in answer.out  # it was finished before


def test_time_left_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from skyproof.cli import console

    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with console.progress_bar("train x") as update:
        for step in range(101, 201):  # resumed at 100: those steps cost no time now
            now[0] += 1.0
            update(step, 200)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  train x ..."
    assert lines[1] == "  train x: 115/200, 15 s, about 85 s left"
    assert lines[-1] == "  train x: done in 100 s"


@pytest.fixture
def blender(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replaces Blender; returns the names of the datasets drawn with Cycles, in order."""
    drawn: list[str] = []

    def render(
        *arguments: Path, rendering: demo.Rendering | None = None, **settings: object
    ) -> None:
        render_folder(*arguments, **settings)  # type: ignore[arg-type]
        if rendering is not None:
            assert (rendering.renderer, rendering.blender) == ("cycles", Path("/opt/blender"))
            labels = arguments[3] / "annotations.json"
            document = read_json(labels)
            document["info"]["renderer"] = "cycles"
            write_json(labels, document)
            drawn.append(arguments[3].name)

    monkeypatch.setattr(demo, "render_folder", render)
    monkeypatch.setattr(demo, "find_blender", lambda path: path)
    return drawn


WITH_CYCLES = [*TINY, "--cycles", "--blender", "/opt/blender"]


def test_cycles_is_added_to_a_finished_demo(
    copied: Callable[..., Path], skyproof: Skyproof, blender: list[str]
) -> None:
    folder = copied()
    before, page = bytes_of(folder), (folder / "report.html").read_text()
    answer = skyproof("demo", "--out", folder, *WITH_CYCLES)
    assert answer.code == 0, answer.err
    assert sorted(blender) == list(CYCLES)
    assert "train retinanet ..." not in answer.out
    assert "On Blender Cycles images" in answer.out
    after = bytes_of(folder)
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"report.html", "environment.json", "timings.json"}
    added = {
        name.rsplit("/", 1)[0]
        for name in after.keys() - before.keys()
        if name.startswith("datasets/")
    }
    assert added == {f"datasets/{name}{inner}" for name in CYCLES for inner in ("", "/images")}
    results = [
        read_json(folder / place / "results.json")["rows"]
        for place in ("evaluation", "evaluation-cycles")
    ]
    # The stand-in draws the same pictures, so all but the name must come out the same.
    assert [{**row, "renderer": "cycles"} for row in results[0]] == results[1]
    assert "which the attack never saw" in (folder / "report.html").read_text()
    assert "Cycles" not in page
    assert read_json(folder / "environment.json")["finished"]
    assert {row["stage"] for row in read_json(folder / "timings.json")} >= {
        "render Cycles",
        "evaluate Cycles",
    }

    # Given again, with Cycles or without: nothing is left to do.
    for flags in (WITH_CYCLES, TINY):
        assert "finished" in skyproof("demo", "--out", folder, *flags).out
    assert bytes_of(folder) == after


def test_cycles_goes_on_where_it_was_stopped(
    copied: Callable[..., Path],
    skyproof: Skyproof,
    blender: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = copied("report.html", "evaluation")
    monkeypatch.setattr(demo, "evaluate_folders", _stopped(demo.evaluate_folders, after=1))
    assert skyproof("demo", "--out", folder, *WITH_CYCLES).code == 130
    assert sorted(blender) == list(CYCLES)
    # The demo itself is done by then, and has its page.
    assert "Cycles" not in (folder / "report.html").read_text()
    monkeypatch.undo()
    monkeypatch.setattr(demo, "find_blender", lambda path: path)
    answer = skyproof("demo", "--out", folder, *WITH_CYCLES)
    assert answer.code == 0, answer.err
    assert "render test-cycles" not in answer.out
    page = (folder / "report.html").read_text()
    assert "Cycles" in page
    # As if stopped between evaluation and page: the older page does not count as finished.
    (folder / "report.html").write_text("old")
    os.utime(folder / "report.html", (0, 0))
    assert skyproof("demo", "--out", folder, *WITH_CYCLES).code == 0
    assert "Time taken" in (folder / "report.html").read_text()


def _stopped(work: Callable[..., object], after: int) -> Callable[..., object]:
    """Does the work so many times; then it is as if the user pressed Ctrl-C."""
    calls = [0]

    def call(*arguments: object, **settings: object) -> object:
        calls[0] += 1
        if calls[0] > after:
            raise KeyboardInterrupt
        return work(*arguments, **settings)

    return call


def test_a_missing_blender_is_said_before_anything_is_done(
    tmp_path: Path, finished: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(path: Path | None) -> None:
        raise ConfigurationError(f"no Blender at {path}; run `make blender`.")

    monkeypatch.setattr(demo, "find_blender", missing)
    contents = bytes_of(finished)
    for folder in (tmp_path / "run", finished):
        skyproof("demo", "--out", folder, *WITH_CYCLES).refused("make blender", "/opt/blender")
    assert not (tmp_path / "run").exists()
    assert bytes_of(finished) == contents
    skyproof("demo", "--out", finished, *TINY, "--blender", "/opt/blender").refused("--cycles")
