"""The demo from nothing to a report, and what a second call does."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skyproof.cli.rendering import Rendering
from skyproof.cli.report import Report
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from tests.barely_trained import everything_counts
from tests.cli.conftest import CHOSEN, TINY, Skyproof, bytes_of

KEYS = {
    "camouflage", "renderer", "detector", "vehicles", "easr", "easr_low", "easr_high", "net_easr",
    "net_easr_low", "net_easr_high", "asr", "er", "ap_original", "ap_adversarial", "apd", "match",
}  # fmt: skip


def test_run_folder_holds_results_and_report(finished: Path) -> None:
    rows = json.loads((finished / "results.json").read_text())["rows"]
    assert {row["match"] for row in rows} == {"centre_1m", "iou_50", "centre_in_box"}
    learnt = {"T-U", "R-U", "T-PixFcMa", "R-PixFcMa"}
    assert {row["camouflage"] for row in rows} == {*learnt, *CHOSEN}
    for row in rows:
        assert row.keys() >= KEYS
        assert (row["renderer"], row["detector"]) == ("torch", "retinanet")
        assert row["vehicles"] > 0
    page = (finished / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    environment = json.loads((finished / "environment.json").read_text())
    assert environment["device"] == "cpu"
    assert environment["finished"]
    times = json.loads((finished / "timings.json").read_text())
    assert {row["stage"] for row in times} >= {"render", "score"}


def test_second_call_changes_nothing(finished: Path, skyproof: Skyproof) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    contents = bytes_of(finished)
    for extra in ([], ["--device", "auto"]):
        answer = skyproof("demo", "--out", finished, *TINY, *extra)
        assert answer.code == 0
        assert "finished" in answer.out
        assert str(finished / "report.html") in answer.out.replace("\n", "")
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before
    skyproof("demo", "--out", finished, *TINY, "--gsd", 0.2).refused("--gsd", "--imagery")
    assert bytes_of(finished) == contents


def test_other_settings_are_refused_and_named(finished: Path, skyproof: Skyproof) -> None:
    contents = bytes_of(finished)
    frames = finished / "nowhere@0.1"
    for flags, name in (
        (["--seed", 1], "seed"),
        (["--attack.steps", 5], "attack"),
        (["--imagery", "/some/orthophoto.tif"], "imagery"),
        (["--frames", frames], "frames"),
        (["--sizes.test-images", 7], "sizes"),
    ):
        skyproof("demo", "--out", finished, *TINY, *flags).refused(
            str(finished), f"({name})", "another --out"
        )
    assert bytes_of(finished) == contents


def test_a_detector_that_finds_nothing_without_camouflage_is_refused(
    copied, skyproof: Skyproof
) -> None:
    """With a threshold above every score there is no success rate.

    No vehicle is found before the camouflage then.
    """
    folder = copied("scores", "report.html", "results.json")
    card = folder / "detectors" / "retinanet" / "detector.json"
    good = card.read_text()
    card.write_text(json.dumps({**json.loads(good), "threshold": 1.0}))
    skyproof("demo", "--out", folder, *TINY).refused(
        "retinanet finds none of the", "threshold of 1"
    )
    assert not (folder / "scores" / "test").exists()
    card.write_text(good)
    assert skyproof("demo", "--out", folder, *TINY).code == 0


def test_every_step_is_announced_without_a_terminal(copied, skyproof: Skyproof) -> None:
    folder = copied("scores", "report.html")
    answer = skyproof("demo", "--out", folder, *TINY)
    assert answer.code == 0
    assert "[19/20] score test (about " in answer.out
    assert "[20/20] report (about " in answer.out
    for name in ("render T-U", "score"):
        assert f"  {name} ..." in answer.out
        assert f"  {name}: done in" in answer.out
    assert "train retinanet" not in answer.out  # it was finished before


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


class Stand(TorchRenderer):
    """In place of Cycles, the differentiable renderer, whose images say that Cycles drew them."""

    name = "cycles"


@pytest.fixture
def blender(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replaces Blender; returns the names of what is drawn with Cycles, in order."""
    drawn: list[str] = []

    @contextmanager
    def opened(
        rendering: Rendering, backgrounds: BackgroundSet, out: Path
    ) -> Iterator[TorchRenderer]:
        if rendering.renderer == "torch":
            yield TorchRenderer(backgrounds)
            return
        assert rendering.blender == Path("/opt/blender")
        drawn.append(out.name)
        yield Stand(backgrounds)

    monkeypatch.setattr("skyproof.cli.renderers.open_renderer", opened)
    monkeypatch.setattr("skyproof.cycles.blender.find_blender", lambda path: path)
    return drawn


BESIDE_RANDOM = {
    "net_easr", "net_easr_low", "net_easr_high", "random_easr", "random_draw_se", "control_p",
    "control_p_holm",
}  # fmt: skip
"""What a row says of a camouflage beside random draws, but for their number."""

WITH_CYCLES = [*TINY, "--cycles", "--blender", "/opt/blender"]


def test_cycles_is_added_to_a_finished_demo(
    copied: Callable[..., Path], skyproof: Skyproof, blender: list[str]
) -> None:
    folder = copied()
    before = bytes_of(folder)
    page = (folder / "report.html").read_text()
    answer = skyproof("demo", "--out", folder, *WITH_CYCLES)
    assert answer.code == 0, answer.err
    assert blender == ["test-cycles", "test-cycles"]
    assert "train retinanet" not in answer.out
    assert "on Blender Cycles images" in answer.out
    after = bytes_of(folder)
    changed = {name for name in before if after[name] != before[name]}
    records = {"environment.json", "timings.json"}
    assert changed == {"results.json", "report.html", *records}
    added = {"/".join(name.split("/")[:2]) for name in after.keys() - before.keys()}
    assert added == {"datasets/test-cycles", "scores/test-cycles"}
    rows = json.loads((folder / "results.json").read_text())["rows"]
    # The stand-in draws the same pictures, so all must come out the same but the name, and what is
    # said beside random patterns, which are not drawn there.
    before_rows = json.loads(before["results.json"])["rows"]
    count = len(before_rows)
    wanted = [row for row in before_rows if row["camouflage"] not in ("R-U", "R-PixFcMa")]
    beside_none = dict.fromkeys(BESIDE_RANDOM) | {"renderer": "cycles", "random_draws": 0}
    assert [{**row, **beside_none} for row in wanted] == rows[count:]
    assert rows[:count] == before_rows
    assert "which the attack never saw" in (folder / "report.html").read_text()
    assert "Cycles" not in page
    assert json.loads((folder / "environment.json").read_text())["finished"]
    times = json.loads((folder / "timings.json").read_text())
    assert {(row["stage"], row["name"]) for row in times} >= {
        ("render", "test-cycles"),
        ("score", "test-cycles"),
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
    folder = copied()

    def stop(self: Report) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Report, "run", stop)
        assert skyproof("demo", "--out", folder, *WITH_CYCLES).code == 130
    assert blender == ["test-cycles", "test-cycles"]
    # The older page does not count as finished.
    answer = skyproof("demo", "--out", folder, *WITH_CYCLES)
    assert answer.code == 0, answer.err
    assert blender == ["test-cycles", "test-cycles"]
    assert "Cycles" in (folder / "report.html").read_text()
    (folder / "report.html").write_text("old")
    os.utime(folder / "report.html", (0, 0))
    assert skyproof("demo", "--out", folder, *WITH_CYCLES).code == 0
    assert "Cycles" in (folder / "report.html").read_text()


def test_a_missing_blender_is_said_before_anything_is_done(
    tmp_path: Path, finished: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(path: Path | None) -> None:
        raise ConfigurationError(f"no Blender at {path}; run `make blender`.")

    monkeypatch.setattr("skyproof.cycles.blender.find_blender", missing)
    contents = bytes_of(finished)
    for folder in (tmp_path / "run", finished):
        skyproof("demo", "--out", folder, *WITH_CYCLES).refused("make blender", "/opt/blender")
    assert not (tmp_path / "run").exists()
    assert bytes_of(finished) == contents
    skyproof("demo", "--out", finished, *TINY, "--blender", "/opt/blender").refused("--cycles")


def test_a_mistake_that_no_finished_step_depends_on_is_corrected(
    tmp_path: Path, finished: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    for made in ("camouflages", "scores", "results.json", "report.html"):
        path = out / made
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    kept = bytes_of(out / "detectors")
    # What the attack needs changes; ground, images and detectors stay.
    none_random = (*TINY, "--sizes.random-draws", 0)
    said = skyproof("demo", "--out", out, *none_random, "--attack.learning-rate", 0.01)
    assert said.code == 0, said.err
    assert "ground" not in said.out
    assert bytes_of(out / "detectors") == kept
    assert json.loads((out / "config.json").read_text())["attack"]["learning_rate"] == 0.01
    # Now the attack is finished, too.
    skyproof("demo", "--out", out, *none_random).refused("(attack)", "finished steps depend on")


def test_any_seed_two_at_once_and_controls_where_there_were_none(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "run"
    call = ("demo", "--out", out, *TINY, "--seed", -1, "--sizes.test-images", 2)
    none_random = (*call, "--sizes.random-draws", 0)
    with alone(out):
        skyproof(*none_random).refused("is being written by another process", str(os.getpid()))
    assert not out.exists()
    with everything_counts():
        said = skyproof(*none_random)
    assert said.code == 0, said.err
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert {row["camouflage"] for row in rows} == {"T-U", "T-PixFcMa"}
    assert all(row["net_easr"] is None for row in rows)
    # The scores have to go, because they are of fewer camouflages.
    shutil.rmtree(out / "scores")
    said = skyproof(*call)
    assert said.code == 0, said.err
    assert (out / "camouflages/R-PixFcMa-1/camouflage.json").exists()
