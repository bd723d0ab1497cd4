"""A run folder: what it refuses, what it keeps, and what it does again."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from skyproof.assessment.run import SOURCES, Run, Step, time_left_s
from skyproof.errors import RunFolderError
from skyproof.files import alone, write_json
from skyproof.layout import Layout
from skyproof.results.stored import read_environment


@dataclass(frozen=True)
class Settings:
    """Of a step."""

    out: Path
    steps: int = 3
    device: str = "cpu"


def step(folder: Path, name: str, settings: object = 1, **more: object) -> Step:
    """Leaves a file that says how often it was made."""
    place = folder / f"{name}.txt"

    def work() -> None:
        place.write_text(f"{place.read_text() if place.exists() else ''}made ")

    return Step("kind", name, (place,), work, settings, **more)  # type: ignore[arg-type]


def done(folder: Path, steps: list[Step], **config: object) -> None:
    run = Run(folder, config, steps)
    with run.begun("cpu"):
        run.do()


def made(folder: Path, name: str) -> int:
    return (folder / f"{name}.txt").read_text().count("made")


def test_what_is_finished_is_kept_and_what_is_not_begun_may_change(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first, second = step(folder, "a"), step(folder, "b")
    done(folder, [first], seed=0, attack=1)
    done(folder, [first, second], seed=0, attack=1)
    assert (made(folder, "a"), made(folder, "b")) == (1, 1)
    second.outputs[0].unlink()
    done(folder, [first, replace(second, settings=2)], seed=0, attack=2)
    assert json.loads(Layout(folder).config.read_text()) == {"seed": 0, "attack": 2}
    before = {path: path.read_bytes() for path in folder.iterdir()}
    for steps in ([replace(first, settings=2), second], [second]):
        with pytest.raises(RunFolderError, match=r"other settings \(attack, seed\) that finished"):
            Run(folder, {"seed": 1, "attack": 3}, steps)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_an_extra_step_may_be_left_out_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first, more = step(folder, "a"), step(folder, "more", extra=True)
    done(folder, [first, more], accept=0.1)
    done(folder, [first], accept=0.2)
    done(folder, [first, more], accept=0.3)
    assert made(folder, "more") == 1


def test_a_step_is_renewed_by_newer_inputs_and_other_settings(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    needed = step(folder, "needed")
    report = step(folder, "report", inputs=needed.outputs, renewed=True)
    done(folder, [needed, report], accept=0.1)
    done(folder, [needed, report], accept=0.1)
    assert made(folder, "report") == 1
    done(folder, [needed, replace(report, settings=2)], accept=0.2)
    assert made(folder, "report") == 2
    os.utime(report.outputs[0], (1, 1))
    done(folder, [needed, replace(report, settings=2)], accept=0.2)
    assert made(folder, "report") == 3
    # It stands for nothing that a later run would have to repeat.
    done(folder, [needed], accept=0.3)


def test_half_of_a_growing_step_counts_as_begun(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    place = folder / "attack" / "done.json"

    def stop() -> None:
        place.parent.mkdir()
        raise KeyboardInterrupt

    attack = Step("attack", "T-U", (place,), stop, {"steps": 1}, growing=True)
    with pytest.raises(KeyboardInterrupt):
        done(folder, [attack], count=1)
    with pytest.raises(RunFolderError, match=r"\(count\)"):
        Run(folder, {"count": 2}, [replace(attack, settings={"steps": 2})])
    Run(folder, {"count": 1}, [attack])


def test_files_that_were_replaced_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done(folder, [step(folder, "a", "digest 1")], **{SOURCES: {"labels.json": "1"}})
    with pytest.raises(RunFolderError, match=r"other content of labels\.json; .* put back what"):
        Run(folder, {SOURCES: {"labels.json": "2"}}, [step(folder, "a", "digest 2")])


def test_a_run_may_be_moved_and_go_on_elsewhere(tmp_path: Path) -> None:
    folder, moved = tmp_path / "run", tmp_path / "elsewhere"
    done(folder, [step(folder, "a", Settings(folder / "camouflages"))], seed=0)
    folder.rename(moved)
    settings = Settings(moved / "camouflages", device="cuda")
    done(moved, [step(moved, "a", settings)], seed=0, more=True)
    assert made(moved, "a") == 1


def test_what_is_no_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    with pytest.raises(RunFolderError, match="not empty and not a run of skyproof"):
        Run(tmp_path, {}, [])
    with pytest.raises(RunFolderError, match="is a file"):
        Run(tmp_path / "mine", {}, [])


def test_a_mistake_is_corrected_before_anything_is_finished(tmp_path: Path) -> None:
    folder = tmp_path / "run"

    def fail() -> None:
        raise RunFolderError("no.")

    with pytest.raises(RunFolderError):
        done(folder, [replace(step(folder, "a"), work=fail)], gsd=1)
    done(folder, [step(folder, "a", 2)], gsd=2)
    assert made(folder, "a") == 1


def test_two_at_once_are_refused(tmp_path: Path) -> None:
    run = Run(tmp_path / "run", {}, [])
    with (
        alone(tmp_path / "run"),
        pytest.raises(RunFolderError, match="another process"),
        run.begun("cpu"),
    ):
        raise AssertionError
    assert not (tmp_path / "run").exists()


def test_a_finished_run_keeps_its_environment(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done(folder, [step(folder, "a")])
    before = Layout(folder).environment.read_bytes()
    assert json.loads(before)["finished"]
    done(folder, [step(folder, "a")])
    assert Layout(folder).environment.read_bytes() == before


def test_the_longest_command_line_is_kept_as_far_as_it_can_be_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photographs = [f"photographs/{number:05}.tif" for number in range(2000)]
    monkeypatch.setattr("sys.argv", ["skyproof", "assess", "mine", *photographs])
    done(tmp_path / "run", [])
    (command,) = read_environment(Layout(tmp_path / "run").environment)["commands"]
    assert command.startswith("skyproof assess mine photographs/00000.tif ")
    assert command.endswith(" …")


def test_a_time_without_a_name_belongs_to_no_step(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done(folder, [])
    rows = [{"stage": "kind", "seconds": 2.0}, {"stage": "kind", "name": "a", "seconds": 1.0}]
    write_json(Layout(folder).timings, rows)
    done(folder, [step(folder, "a")])
    times = json.loads(Layout(folder).timings.read_text())
    assert times[0] == rows[0]
    assert times[1]["seconds"] == pytest.approx(1.0, abs=0.5)


def test_time_left_by_effort(tmp_path: Path) -> None:
    efforts = (1.0, 1999.0, 5000.0)
    steps = [step(tmp_path, str(number), effort_s=effort) for number, effort in enumerate(efforts)]
    assert time_left_s(steps, {}) is None
    # Half as fast as thought: 10,000 s are left for one core.
    seconds = {"kind/0": 2.0, "kind/1": 3998.0}
    left_s = time_left_s(steps, seconds)
    assert left_s == pytest.approx(10_000, rel=0.03)
    assert time_left_s(steps, seconds, cores=2) == left_s / 2
    # A first short step that took ten times as long says little about the others.
    assert time_left_s(steps, {"kind/0": 10.0}) == pytest.approx(7_000, rel=0.2)


def test_a_run_does_not_write_through_links(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done(folder, [step(folder, "a")])
    (tmp_path / "elsewhere").mkdir()
    (folder / "scores").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunFolderError, match="scores is a link to a folder elsewhere"):
        Run(folder, {}, [step(folder, "a")])
