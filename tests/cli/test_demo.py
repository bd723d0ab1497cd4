"""The demo from nothing to a report, and what a second call does."""

import json
from pathlib import Path

import pytest

from tests.cli.conftest import TINY, Skyproof, bytes_of

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
    assert {row["stage"] for row in json.loads((finished / "timings.json").read_text())} >= {"render", "evaluate"}


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
        skyproof("demo", "--out", finished, *TINY, *flags).refused(str(finished), f"({name})", "another --out")
    assert bytes_of(finished) == contents


def test_a_detector_that_finds_nothing_is_refused(copied, skyproof: Skyproof) -> None:
    """A threshold above every score: no vehicle is found before the camouflage, so there is no success rate."""
    folder = copied("evaluation", "report.html", "results.json")
    card = folder / "detectors" / "retinanet" / "detector.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "threshold": 1.0}))
    skyproof("demo", "--out", folder, *TINY).refused("retinanet finds none", "EASR", "train it longer")
    assert not (folder / "evaluation").exists()


def test_no_random_control_is_possible(tmp_path: Path, skyproof: Skyproof) -> None:
    answer = skyproof("demo", "--out", tmp_path / "run", *TINY, "--sizes.random-draws", 0, "--sizes.test-images", 2)
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


def test_time_left_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
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
