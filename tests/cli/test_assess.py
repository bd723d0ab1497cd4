"""`skyproof assess` on drawn ground, by a suite that is far too small."""

import json
import shutil
from dataclasses import replace

import pytest

from skyproof.attacks.settings import QuerySettings
from skyproof.detectors.reference_detectors import reference_folder
from skyproof.layout import Layout
from skyproof.main import run
from skyproof.plans import assess, run_folder
from skyproof.plans.answers import say_expected
from skyproof.plans.enough import Enough
from skyproof.plans.suite import Expected, read_suite
from tests.cli.conftest import Skyproof, bytes_of

WHOLE = read_suite()
TINY = replace(
    WHOLE,
    attacks=("T-U", "S-O@0.2"),
    settings=replace(WHOLE.settings, batch_size=1, balance_batches=1),
    steps=replace(WHOLE.steps, texture=2, shape=2),
    draws=1,
    best_of=2,
    attack_m=12.0,
    image_m=16.0,
    test_images=6,
    tiles=(1, 1, 2, 4),
    vehicles=(1, 1, 2, 2),
    check_scenes=1,
    check_draws=1,
    queries=QuerySettings(images=72, batch_size=1, keep_at=(15,)),
    compared=("T-U",),
    expected={},
)


@pytest.fixture(scope="module", autouse=True)
def suite():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assess, "read_suite", lambda: TINY)
        yield


@pytest.fixture(scope="module")
def assessed(suite, tmp_path_factory):
    """A finished assessment; not to be changed."""
    folder = tmp_path_factory.mktemp("assess")
    shutil.copytree(reference_folder("retinanet"), folder / "mine")
    call = ["assess", str(folder / "mine"), "--out", str(folder / "run"), "--device", "cpu"]
    assert run(call) == 0
    return folder


def test_from_a_detector_folder_to_a_report(assessed):
    results = json.loads((assessed / "run/results.json").read_text())
    rows = {row["camouflage"] for row in results["rows"]}
    assert rows >= {
        *TINY.attacks,
        "R-U",
        "R-S-O@0.2",
        "R-U_plain",
        "R-U_best",
        "R-U_search",
        "T-U_asked",
    }
    (worst,) = results["worst_cases"]
    assert worst["attacks"] == list(TINY.attacks)
    config = json.loads((assessed / "run/config.json").read_text())
    assert config["suite"]["version"] == 3
    assert config["imagery"] == "procedural"
    check = json.loads((assessed / "run/detectors/retinanet/check.json").read_text())
    # What was measured when the detector was made is not what is found here.
    assert check["measured_on"]["scenes"] == 1
    page = (assessed / "run/report.html").read_text()
    assert "at least one of the 2 attacks hides" in page
    assert "By its answers alone" in page


def test_a_second_call_changes_nothing_and_says_the_answer(
    assessed, skyproof: Skyproof, monkeypatch
):
    before = bytes_of(assessed)
    monkeypatch.setattr(run_folder, "_now", lambda: "another second")
    again = skyproof("assess", assessed / "mine", "--out", assessed / "run", "--device", "cpu")
    assert again.code == 0
    assert "the answer says nothing of your places" in again.out
    assert "T-U hides " in again.out
    assert "at least one of the 2 attacks hides " in again.out
    assert bytes_of(assessed) == before


def test_another_detector_or_seed_is_refused(assessed, skyproof: Skyproof):
    call = ("assess", assessed / "mine", "--out", assessed / "run")
    skyproof(*call, "--seed", 1).refused("(seed)", "another --out")
    skyproof(*call, "--accept", 0.1, "--reject", 0.2).refused("requirement", "another --out")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--labels", "x.json"], ["--labels", "give --imagery too"]),
        (["--gsd", 0.1], ["--gsd", "give --imagery too"]),
        (["--imagery", ".", "--label-classes", "car"], ["--label-classes", "give --labels too"]),
        (["--imagery", "no.tif"], ["no.tif is not there", "--imagery"]),
        (["--imagery", ".", "--labels", "no.json"], ["no.json is not there", "--labels"]),
        (["--vehicle-classes", "car"], ["--vehicle-classes is for checkpoint files"]),
        (["--architecture", "fcos_resnet50_fpn"], ["--architecture is for checkpoint files"]),
        (["--accept", 0.3, "--reject", 0.2], ["0.3 and 0.2", "exchange them"]),
        (["--accept", 0.3], ["--accept and --reject, got only one"]),
        (["--blender", "/x"], ["--blender", "give --cycles too"]),
    ],
)
def test_options_that_contradict_are_one_sentence(assessed, skyproof: Skyproof, options, words):
    out = assessed / "never"
    skyproof("assess", assessed / "mine", "--out", out, *options).refused(*words)
    assert not out.exists()


def test_detectors_that_are_not_there_or_say_no_classes(tmp_path, skyproof: Skyproof):
    out = tmp_path / "run"
    skyproof("assess", tmp_path / "none", "--out", out).refused("is not there")
    file = tmp_path / "best.pt"
    file.touch()
    skyproof("assess", file, "--out", out).refused("best.pt is a checkpoint", "--vehicle-classes")
    assert not out.exists()


def test_too_little_ground_for_the_risks_stops_before_anything_is_learnt(
    assessed, tmp_path, skyproof: Skyproof
):
    out = tmp_path / "run"
    call = ("assess", assessed / "mine", "--out", out, "--device", "cpu")
    skyproof(*call, "--accept", 0.2, "--reject", 0.3).refused(
        "has 4 test tiles", "times as much imagery"
    )
    assert not Layout(out).fleets.exists()
    ground = Enough(Layout(out).backgrounds, 0.9, 0.3, tmp_path / "enough.json")
    ground.run()
    assert json.loads((tmp_path / "enough.json").read_text())["test_tiles"] == 4


@pytest.mark.parametrize(("low", "weaker"), [(-1.0, False), (1.01, True)])
def test_attacks_on_a_reference_detector_are_compared_with_what_is_expected(
    assessed, tmp_path, monkeypatch, low, weaker
):
    folder = tmp_path / "run"
    shutil.copytree(assessed / "run", folder)
    said = []
    monkeypatch.setattr("skyproof.plans.answers.say", said.append)
    expected = {"retinanet": {"T-U": Expected(easr=1.02, low=low, high=1.03)}}
    say_expected(Layout(folder), replace(TINY, expected=expected))
    rows = json.loads((folder / "suite.json").read_text())["rows"]
    assert [(row["camouflage"], row["weaker"]) for row in rows] == [("T-U", weaker)]
    assert any("WEAKER THAN EXPECTED" in line for line in said) == weaker
    # Another detector of that name is not expected to do anything.
    (folder / "suite.json").unlink()
    card = folder / "detectors/retinanet/detector.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "threshold": 0.5}))
    say_expected(Layout(folder), replace(TINY, expected=expected))
    assert not (folder / "suite.json").exists()
