"""`skyproof reproduce`: refusals, a dry run, a failing job and an interruption.

The whole of it is tested in tests/reproduction.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from skyproof.cycles.blender import Blender
from skyproof.detectors.card import DetectorCard, write_card
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from tests.cli.conftest import Skyproof

TINY = Path(__file__).parents[1] / "reproduction" / "tiny.json"


def test_dry_run_says_what_would_be_done_and_writes_nothing(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "run"
    answer = skyproof("reproduce", "--preset", TINY, "--out", out, "--dry-run")
    assert answer.code == 0, answer.err
    counted = "ground 1, vehicles 1, scenes 4, render 4, train 1, control 1, attack 4"
    assert f"20 steps ({counted}, score 2, looks 1, report 1)" in answer.out
    assert "-m snakemake --snakefile" in answer.out
    assert f"mkdir -p {out}\n  cp -r {TINY} {out / 'config.json'}\n" in answer.out
    assert not out.exists()


def stub_blender(monkeypatch: pytest.MonkeyPatch, found: Path | None) -> list[Path | None]:
    """Blender is at `found`, or nowhere; gives where it was looked for."""
    asked: list[Path | None] = []

    def find_blender(path: Path | None) -> Blender:
        asked.append(path)
        if found is None:
            raise ConfigurationError("Cycles needs Blender; run make blender.")
        return Blender(found, is_python=True, version="4.5.0")

    monkeypatch.setattr("skyproof.reproduction.reproduce.find_blender", find_blender)
    return asked


def test_the_cycles_column_is_asked_for(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    asked = stub_blender(monkeypatch, Path("here/python"))
    answer = skyproof(
        "reproduce", "--preset", TINY, "--out", out, "--dry-run", "--cycles", "--blender", "mine"
    )
    assert answer.code == 0, answer.err
    assert asked == [Path("mine")]
    assert "23 steps" in answer.out
    assert "render 5, train 1, control 1, attack 4, score 4, looks 1, report 1" in answer.out
    # Jobs run in the run folder: the path must not depend on where the command was given.
    assert f"--config blender={Path.cwd() / 'here' / 'python'}" in answer.out
    assert not out.exists()


def test_cycles_without_blender_is_refused_before_anything_is_written(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    skyproof("reproduce", "--preset", TINY, "--out", out, "--blender", "mine").refused(
        "--blender", "--cycles"
    )
    stub_blender(monkeypatch, None)
    skyproof("reproduce", "--preset", TINY, "--out", out, "--cycles").refused("make blender")
    assert not out.exists()


def test_a_finished_run_takes_the_cycles_column_and_says_what_is_new(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "config.json").write_text(json.dumps({"preset": "tiny", **json.loads(TINY.read_text())}))
    done = {"ground/ground": 3.0, "score/000": 5.0, "score/001": 6.0, "report/report": 2.0}
    write_benchmarks(out, done, 1000)
    stub_blender(monkeypatch, Path("/blender"))
    monkeypatch.setattr(
        "skyproof.reproduction.reproduce.snakemake_words", stub_snakemake(tmp_path, out)
    )
    answer = skyproof("reproduce", "--preset", TINY, "--out", out, "--cycles", "--cores", 2)
    assert answer.code == 0, answer.err
    assert "4 steps were finished before" in answer.out
    said = [line.strip() for line in answer.out.splitlines() if line.startswith("  ")][1:]
    # The report was written again, in another time.
    assert [line.partition(" s (")[0] for line in said] == ["score cycles-000: 9", "report: 4"]
    assert "(6 of 23 steps" not in answer.out
    assert "(5 of 23 steps" in said[-1]
    assert json.loads((out / "config.json").read_text()).keys() == {
        "preset",
        *json.loads(TINY.read_text()),
    }
    # Without the flag the column's jobs are not counted.
    again = skyproof("reproduce", "--preset", TINY, "--out", out, "--cores", 2)
    assert "4 steps were finished before" in again.out


def write_benchmarks(out: Path, jobs: dict[str, float], start: float) -> None:
    """As Snakemake leaves them, one second after the other."""
    for age, (name, seconds) in enumerate(jobs.items()):
        path = out / "benchmarks" / f"{name}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"s\th:m:s\tmax_rss\n{seconds}\t0:00:01\t-\n")
        os.utime(path, (start + age, start + age))


def stub_snakemake(tmp_path: Path, out: Path) -> Callable[..., list[str]]:
    """In place of Snakemake, a script that leaves what two finished jobs would."""
    new = tmp_path / "new"
    write_benchmarks(new, {"score/cycles-000": 9.0, "report/report": 4.0}, 2000)
    script = f"import shutil; shutil.copytree({str(new)!r}, {str(out)!r}, dirs_exist_ok=True)"
    return lambda *_: [sys.executable, "-c", script, "--"]


def test_bad_input_is_refused_before_anything_is_written(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    skyproof("reproduce", "--preset", "quik", "--out", out).refused("quick", "paper", "quik")
    skyproof("reproduce", "--preset", TINY, "--out", out, "--cores", 0).refused("--cores", "0")
    skyproof("reproduce", "--preset", TINY, "--out", out, "--device", "cuda:99").refused("cuda:99")
    other = tmp_path / "other.json"
    other.write_text(json.dumps({**json.loads(TINY.read_text()), "detectors": ["ssd"]}))
    skyproof("reproduce", "--preset", other, "--out", out).refused("ssd")
    monkeypatch.setattr("skyproof.reproduction.reproduce.find_spec", lambda name: None)
    skyproof("reproduce", "--preset", TINY, "--out", out, "--cores", 2).refused(
        "pip install 'skyproof[reproduce]'", "--cores 1"
    )
    assert not out.exists()


def detector(place: Path, images: str, *, name: str = "retinanet") -> Path:
    """A detector folder as far as it is read before anything is computed."""
    place.mkdir()
    training = {"images": 60, "data_sha256": images}
    card = DetectorCard(name, threshold=0.4, gsd_m=0.125, training=training, trained_on=images)
    write_card(place / "detector.json", replace(card, weights_sha256=images))
    return place


def test_held_out_detectors_are_asked_for(tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "run"
    first = detector(tmp_path / "first", "photographs")
    asked = ("reproduce", "--preset", TINY, "--out", out, "--held-out", f"real={first}")
    answer = skyproof(*asked, "--dry-run")
    assert answer.code == 0, answer.err
    assert "22 steps" in answer.out
    assert "score 4, looks 1, report 1" in answer.out
    # By hand they are put where the run has them.
    place = out / "judges" / "real" / "detectors"
    assert f"mkdir -p {place}\n" in answer.out
    assert f"cp -r {first} {place / 'retinanet'}\n" in answer.out
    assert not out.exists()


def test_held_out_detectors_of_different_images_in_one_table_are_refused(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    first = detector(tmp_path / "first", "photographs")
    second = detector(tmp_path / "second", "renders", name="faster_rcnn")
    given = ("reproduce", "--preset", TINY, "--out", tmp_path / "run", "--held-out", first)
    skyproof(*given, second).refused("have different training images", "photographs", "renders")
    skyproof(*given, tmp_path / "nowhere").refused("nowhere", "detector.json")
    skyproof(*given, f"a b={second}").refused("--held-out", "TABLE=")
    assert not (tmp_path / "run").exists()


def test_a_run_keeps_its_held_out_detectors_and_refuses_others_in_their_place(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    first = detector(tmp_path / "first", "photographs")
    monkeypatch.setattr(
        "skyproof.reproduction.reproduce.snakemake_words", stub_snakemake(tmp_path, out)
    )
    given = ("reproduce", "--preset", TINY, "--out", out, "--cores", 2)
    answer = skyproof(*given, "--held-out", first)
    assert answer.code == 0, answer.err
    assert "22 steps" in answer.out
    stored = out / "judges" / "judges" / "detectors" / "retinanet" / "detector.json"
    assert stored.read_text() == (first / "detector.json").read_text()
    # They belong to the run from then on, asked for or not.
    assert "22 steps" in skyproof(*given).out
    other = detector(tmp_path / "other", "other photographs")
    skyproof(*given, "--held-out", other).refused("table judges of other detectors", "OTHER=")
    assert "24 steps" in skyproof(*given, "--held-out", f"more={other}").out


def test_another_run_in_the_folder(tmp_path: Path, skyproof: Skyproof) -> None:
    (tmp_path / "run").mkdir()
    # A run stopped before its first stage: only these two are there.
    (tmp_path / "run" / "config.json").write_text(
        json.dumps({"preset": "tiny", **json.loads(TINY.read_text())})
    )
    with alone(tmp_path / "run"):
        skyproof("reproduce", "--preset", TINY, "--out", tmp_path / "run").refused(
            "is being written by another process", str(os.getpid())
        )
    (tmp_path / "run" / "fleets").mkdir()
    (tmp_path / "run" / "steps.json").write_text("{}")
    changed = tmp_path / "tiny.json"
    changed.write_text(json.dumps({**json.loads(TINY.read_text()), "seed": 5}))
    skyproof("reproduce", "--preset", changed, "--out", tmp_path / "run").refused(
        "(seed)", "another --out"
    )


def test_a_failing_step_is_named_with_its_last_words(tmp_path: Path, skyproof: Skyproof) -> None:
    broken = tmp_path / "broken.json"
    tiny = json.loads(TINY.read_text())
    # Damaged ground: found where it is read.
    out = tmp_path / "run"
    broken.write_text(json.dumps(tiny))
    (out / "backgrounds").mkdir(parents=True)
    (out / "backgrounds" / "index.json").write_text("{")
    (out / "config.json").write_text(json.dumps({"preset": "broken", **tiny}))
    answer = skyproof("reproduce", "--preset", broken, "--out", out, "--cores", 2)
    answer.refused("A step failed (", "index.json is not JSON", str(out / "logs"), "same command")


def test_a_wrong_world_is_refused_before_anything_is_written(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    broken = tmp_path / "broken.json"
    tiny = json.loads(TINY.read_text())
    for changes, word in (({"test_images": 0}, "test_images"), ({"sun": 1}, "'sun'")):
        broken.write_text(json.dumps({**tiny, "world": {**tiny["world"], **changes}}))
        skyproof("reproduce", "--preset", broken, "--out", tmp_path / "run").refused(word)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_its_end_ends_all_processes(tmp_path: Path, number: signal.Signals) -> None:
    command = [
        sys.executable,
        "-m",
        "skyproof",
        "reproduce",
        "--preset",
        TINY,
        "--out",
        tmp_path / "run",
        "--cores",
        "2",
    ]
    run = subprocess.Popen(
        list(map(str, command)),
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        # A parent may have had interrupts ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    until = time.monotonic() + 60
    while (
        time.monotonic() < until
        and not (tmp_path / "run" / "logs" / "ground" / "ground.log").exists()
    ):
        time.sleep(0.05)
    below = psutil.Process(run.pid).children(recursive=True)
    assert len(below) >= 2  # Snakemake and a job
    run.send_signal(number)
    if number == signal.SIGINT:
        assert run.wait(60) == 130
        assert run.stderr is not None
        assert run.stderr.read() == "skyproof: stopped; give the same command again to go on.\n"
    else:
        # Nothing of ours runs after a kill but what watches.
        assert run.wait(60) == -signal.SIGKILL
        psutil.wait_procs(below, timeout=60)
        with alone(tmp_path / "run"):
            pass
    assert not [
        process
        for process in below
        if process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    ]
