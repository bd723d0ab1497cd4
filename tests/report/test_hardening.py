"""What the report says of hardening, and that its commands are ones that work."""

import html
import re
import shlex
import shutil

import pytest
import tyro

from skyproof.main import load_command
from skyproof.report.advice import readings
from skyproof.report.report import write_report
from skyproof.results.conditions import Bin, Panel
from skyproof.results.statistics.intervals import Interval
from skyproof.scenes.scene import BackgroundWindow, Camera, Scene, Sun, write_scenes
from tests.report.fabricate import HIDES, fabricate
from tests.report.test_precheck import checked


def with_world(folder):
    """Adds what a run folder has of ground, vehicles and scenes."""
    (folder / "backgrounds").mkdir()
    (folder / "backgrounds/index.json").write_text("{}")
    (folder / "fleets/attack").mkdir(parents=True)
    camera = Camera(tilt_rad=0.0, azimuth_rad=0.0, gsd_m=0.125, size_px=192)
    window = BackgroundWindow("tile", 96.0, 96.0, 0.0)
    scene = Scene("scene", window, camera, Sun(0.0, 1.0), (), seed=0)
    (folder / "scenes").mkdir()
    write_scenes(folder / "scenes/test.jsonl", [scene])
    return folder


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A fabricated run with its world."""
    return with_world(fabricate(tmp_path_factory.mktemp("run"), scenes=16))


def commands(page):
    """The words of the commands that the page gives."""
    (block,) = re.findall(r"<pre>(skyproof (?:render|vehicles).*?)</pre>", page, flags=re.S)
    return [shlex.split(html.unescape(line)) for line in block.split("\n")]


def test_the_strongest_attack_is_trained_against_with_commands_that_parse(run_folder):
    page = write_report(run_folder).read_text()
    assert "T-U hides most. Add images" in page
    assert "not those of the test" in page
    given = commands(page)
    assert [words[:2] for words in given] == [["skyproof", "render"]]
    assert given[0][given[0].index("--settings.size-px") + 1] == "192"
    for words in given:
        assert "test" not in " ".join(words)
        tyro.cli(load_command(words[1]), args=words[2:], console_outputs=False)


@pytest.mark.parametrize("fails", [True, False])
def test_who_fails_at_paints_adds_vehicles_in_many_coats_first(run_folder, tmp_path, fails):
    copied = shutil.copytree(run_folder, tmp_path / "run")
    yellow = Interval(0.97, 0.9, 0.99) if fails else Interval(0.06, -0.01, 0.1)
    checked(copied, "retinanet", {("paint_body", "#ffff00"): yellow})
    page = write_report(copied).read_text()
    assert ("First, plain paints or random patterns hide" in page) == fails
    given = commands(page)
    coats = ["vehicles", "render"] if fails else []
    assert [words[1] for words in given] == [*coats, "render"]
    for words in given:
        tyro.cli(load_command(words[1]), args=words[2:], console_outputs=False)


@pytest.mark.parametrize("part", ["backgrounds", "fleets", "scenes", "camouflages"])
def test_nothing_is_advised_that_cannot_be_done(run_folder, tmp_path, part):
    copied = shutil.copytree(run_folder, tmp_path / "run")
    shutil.rmtree(copied / part)
    page = write_report(copied).read_text()
    assert "Hardening:" not in page
    assert "What it means for the detectors" in page


def test_an_attack_that_may_hide_nothing_asks_for_no_hardening(tmp_path, monkeypatch):
    monkeypatch.setitem(HIDES, "T-U", 0.0)
    page = write_report(with_world(fabricate(tmp_path / "run", scenes=16))).read_text()
    assert "What it means for the detectors" in page
    assert "Hardening:" not in page


def test_readings_name_the_extremes_where_intervals_part():
    def panel(title, *rates):
        bins = [Bin(f"bin {i}", 50, Interval(r, r - 0.1, r + 0.1)) for i, r in enumerate(rates)]
        return Panel(title, bins, 0.5)

    apart, close, alone = panel("Tilt", 0.2, 0.9, 0.5), panel("Sun", 0.4, 0.5), panel("Body", 0.4)
    assert readings([apart, close, alone]) == [
        "Tilt: most hidden at bin 1 (90\u202f%), least at bin 0 (20\u202f%); the intervals do not "
        "overlap.",
        "Sun: no clear difference; the intervals overlap.",
    ]
