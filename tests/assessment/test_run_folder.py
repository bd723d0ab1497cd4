"""A run folder given other settings: what is finished stays, or the run is refused."""

from dataclasses import replace
from pathlib import Path

import pytest

from skyproof.assessment.demo import Demo, demo_plan
from skyproof.assessment.run_folder import RunFolder
from skyproof.attacks.settings import AttackSettings
from skyproof.errors import RunFolderError
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.results.stored import read_environment


def opened(demo: Demo) -> RunFolder:
    """The demo's run folder, if what is in it belongs to the demo."""
    plan = demo_plan(demo, Layout(demo.out))
    return RunFolder(demo.out, demo._config(), plan, demo._plan_of)


@pytest.mark.parametrize("imagery", [(), (Path("a.tif"), Path("/b c/d.tif"))], ids=len)
def test_a_demo_takes_corrected_settings_of_what_is_not_begun(
    imagery: tuple[Path, ...], tmp_path: Path
) -> None:
    demo = Demo(tmp_path / "run", imagery=imagery)
    opened(demo).start("cpu")
    Layout(demo.out).backgrounds.mkdir()
    begun = [step.id for step in demo_plan(demo, Layout(demo.out)).steps if step.is_begun()]
    assert begun == ["ground/ground"]
    opened(replace(demo, attack=AttackSettings(steps=7)))
    with pytest.raises(RunFolderError, match=r"other settings \(seed\)"):
        opened(replace(demo, seed=1))
    with pytest.raises(RunFolderError, match=r"other settings \(imagery\)"):
        opened(replace(demo, imagery=(Path("e.tif"),)))


def test_the_longest_command_line_is_kept_as_far_as_it_can_be_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo = Demo(tmp_path / "run")
    photographs = [f"photographs/{number:05}.tif" for number in range(2000)]
    monkeypatch.setattr("sys.argv", ["skyproof", "assess", "mine", *photographs])
    opened(demo).start("cpu")
    (command,) = read_environment(Layout(demo.out).environment)["commands"]
    assert command.startswith("skyproof assess mine photographs/00000.tif ")
    assert command.endswith(" …")


def test_a_time_without_a_name_belongs_to_no_step(tmp_path: Path) -> None:
    demo = Demo(tmp_path / "run")
    run = opened(demo)
    run.start("cpu")
    drawn = {"stage": "ground", "name": "ground", "seconds": 1.0}
    rows = [{"stage": "scenes", "seconds": 2.0}, drawn]
    write_json(Layout(demo.out).timings, rows)
    assert run.seconds()["ground/ground"] == 1.0
    (ground,) = (step for step in demo_plan(demo, Layout(demo.out)).steps if step.kind == "ground")
    run.timed(ground, lambda: None)
    assert run.seconds()["ground/ground"] == pytest.approx(1.0, abs=0.5)
