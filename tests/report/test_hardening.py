"""What the report says of hardening, and that its command is one that works."""

import json
import re
import shutil
from pathlib import Path

import pytest
import tyro
from msgspec import to_builtins
from msgspec.structs import replace

from skyproof.detectors.card import PARENT_FILE
from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.main import load_command
from skyproof.report.advice import readings
from skyproof.report.hardened import as_parent, first_pictures
from skyproof.report.report import write_report
from skyproof.results.conditions import Bin, Panel
from skyproof.results.results import Results
from skyproof.results.statistics.intervals import Interval
from skyproof.scenes.scene import BackgroundWindow, Camera, Scene, Sun, write_scenes
from skyproof.words import percent
from tests.report.fabricate import DETECTORS, HIDES, fabricate


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


COMMAND = "<pre>skyproof harden . --out ../hardened</pre>"


def test_of_several_detectors_one_is_to_be_assessed_alone(run_folder):
    page = write_report(run_folder).read_text()
    assert "T-U hides most. First assess one detector alone with skyproof assess" in page
    assert COMMAND in page


@pytest.fixture
def of_one(tmp_path, monkeypatch):
    """A fabricated run of a single detector with its world."""
    monkeypatch.setattr("tests.report.fabricate.DETECTORS", DETECTORS[:1])
    return with_world(fabricate(tmp_path / "run", scenes=16))


@pytest.mark.parametrize("size", ["slim", ""])
def test_one_command_trains_a_detector_or_renders_for_its_own_training(of_one, size):
    config = json.loads((of_one / "config.json").read_text())
    suite = {"version": 6, "sha256": "0" * 64, "scored": []}
    (of_one / "config.json").write_text(json.dumps({**config, "suite": suite}))
    place = of_one / "detectors" / DETECTORS[0] / "detector.json"
    write_json(place, {**json.loads(place.read_text()), "size": size})
    page = write_report(of_one).read_text()
    assert COMMAND in page
    assert "Give this command in the run folder" in page
    assert ("It trains the detector further" in page) == bool(size)
    assert ("What to expect" in page) == bool(size)
    assert ("It renders images to add to the training" in page) == (not size)
    command = tyro.cli(
        load_command("harden"), args=[".", "--out", "../hardened"], console_outputs=False
    )
    assert command.run_folder == Path(".")


def test_a_hardened_detector_stands_beside_its_parent(of_one, tmp_path, monkeypatch):
    write_report(of_one)
    rows = json.loads((of_one / "results.json").read_text())
    monkeypatch.setitem(HIDES, "T-U", 0.25)
    after = with_world(fabricate(tmp_path / "after", scenes=16))
    folder = after / "detectors" / DETECTORS[0]
    results = Results.open(of_one)
    parent = as_parent(results, ["T-U", "T-Ma"], "0" * 64)
    shown = {name: f"data:image/jpeg;base64,{name.encode().hex()}" for name in parent.rates}
    parent = replace(parent, pictures=shown)
    write_json(folder / PARENT_FILE, to_builtins(parent))
    page = write_report(after).read_text()
    # The same scene before and after, in an attack on each detector.
    (own,) = first_pictures(Results.open(after), ["T-U"]).values()
    for picture, words in ((shown["T-U"], "before"), (own, "after")):
        assert f'<img src="{picture}" alt="With T-U, {words} hardening">' in page
        # The first figure shows them beside the scene without camouflage.
        assert re.search(f'<img src="{re.escape(picture)}" alt="Scene .* with T-U, {words}', page)
    (table,) = re.findall(r"before and after hardening, each by.*?</table>", page, flags=re.S)
    (row,) = re.findall(r"<tr><td>T-U</td>(.*?)</tr>", table, flags=re.S)
    (hidden,) = (
        one["easr"]
        for one in rows["rows"]
        if (one["camouflage"], one["match"], one["renderer"]) == ("T-U", "centre_1m", "torch")
    )
    later = json.loads((after / "results.json").read_text())["rows"][0]
    assert later["camouflage"] == "T-U"
    assert hidden > later["easr"] + 0.3
    assert re.findall(r"<td>(.*?)<br>", row)[:2] == [percent(hidden), percent(later["easr"])]
    assert "Hardening showed it T-U and T-Ma; all other attacks were held out." in page
    assert f"from its parent {percent(hidden)} (T-U)" in page
    assert "There, T-U surely hides fewer vehicles than before." in page
    # The same detector again has gained nothing.
    write_json(folder / PARENT_FILE, to_builtins(as_parent(Results.open(after), ["T-U"], "0" * 64)))
    assert (
        "There, no attack surely hides fewer vehicles than before"
        in write_report(after).read_text()
    )
    write_json(folder / PARENT_FILE, to_builtins(parent))
    # A comparison on other scenes would say nothing.
    (after / "scenes/test.jsonl").write_bytes((after / "scenes/test.jsonl").read_bytes() + b"\n")
    page = write_report(after).read_text()
    assert "Its parent was assessed on other scenes" in page
    assert "each by attacks" not in page
    for picture in ("https://example.org/a.jpg", "data:image/svg+xml;base64,AA==", "x" * 10**7):
        forged = {**to_builtins(parent), "pictures": {"T-U": picture}}
        write_json(folder / PARENT_FILE, forged)
        with pytest.raises(StoredFileError, match="harden the detector again"):
            write_report(after)
    (folder / PARENT_FILE).write_text("{}")
    with pytest.raises(StoredFileError, match="harden the detector again"):
        write_report(after)


@pytest.mark.parametrize("part", ["backgrounds", "fleets", "scenes", "camouflages"])
def test_nothing_is_advised_that_cannot_be_done(run_folder, tmp_path, part):
    copied = shutil.copytree(run_folder, tmp_path / "run")
    shutil.rmtree(copied / part)
    page = write_report(copied).read_text()
    assert "<h3>Hardening</h3>" not in page
    assert "What it means for the detectors" in page


def test_an_attack_that_may_hide_nothing_asks_for_no_hardening(tmp_path, monkeypatch):
    monkeypatch.setitem(HIDES, "T-U", 0.0)
    page = write_report(with_world(fabricate(tmp_path / "run", scenes=16))).read_text()
    assert "What it means for the detectors" in page
    assert "<h3>Hardening</h3>" not in page


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
