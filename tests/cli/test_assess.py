"""`skyproof assess` on drawn ground, by a suite that is far too small."""

import json
import shutil
from dataclasses import replace

import pytest

from skyproof.assessment import assess, environment
from skyproof.assessment.answers import say_answers, say_expected
from skyproof.assessment.suite import Expected, read_suite
from skyproof.attacks.settings import QuerySettings
from skyproof.detectors.card import reference_folder
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.main import run
from skyproof.results.statistics.acceptance import fewest_tiles
from tests.cli.conftest import Skyproof, bytes_of

WHOLE = read_suite()
TINY = replace(
    WHOLE,
    attacks=("T-U", "S-O@0.2"),
    settings=replace(WHOLE.settings, batch_size=1, balance_batches=1),
    steps=replace(WHOLE.steps, texture=2, shape=2),
    draws=1,
    best_of=2,
    searches=2,
    attack_m=12.0,
    image_m=16.0,
    test_images=6,
    empty_images=6,
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
        patch.setattr(assess, "read_suite", lambda *_: TINY)
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
    repeats = {row["camouflage"]: row["repeats"] for row in results["rows"]}
    assert (repeats["R-U_best"], repeats["R-U_search"]) == (1, 2)
    (worst,) = results["worst_cases"]
    assert worst["attacks"] == list(TINY.attacks)
    config = json.loads((assessed / "run/config.json").read_text())
    assert config["suite"]["version"] == 10
    assert config["imagery"] == "procedural"
    check = json.loads((assessed / "run/detectors/retinanet/precheck.json").read_text())
    # What was measured when the detector was made is not what is found here.
    assert check["measured_on"]["scenes"] == 1
    page = (assessed / "run/report.html").read_text()
    assert "At least one of the 2 attacks hides" in page
    assert "Query attacks" in page


def test_a_second_call_changes_nothing_and_says_the_answer(
    assessed, skyproof: Skyproof, monkeypatch
):
    before = bytes_of(assessed)
    monkeypatch.setattr(environment, "_now", lambda: "another second")
    again = skyproof("assess", assessed / "mine", "--out", assessed / "run", "--device", "cpu")
    assert again.code == 0
    assert "the result says nothing about your sites" in again.out
    assert "T-U hides " in again.out
    assert "at least one of the 2 attacks hides " in again.out
    assert bytes_of(assessed) == before


def test_another_detector_or_seed_is_refused(assessed, skyproof: Skyproof):
    call = ("assess", assessed / "mine", "--out", assessed / "run")
    skyproof(*call, "--seed", 1).refused("(seed)", "another --out")
    card = assessed / "mine/detector.json"
    whole = card.read_bytes()
    card.write_bytes(whole + b"\n")
    try:
        skyproof(*call).refused("other content of", str(assessed / "mine"), "put back what they")
    finally:
        card.write_bytes(whole)


@pytest.mark.slow
def test_a_finished_run_is_asked_for_a_verdict(assessed, tmp_path, skyproof: Skyproof):
    folder = tmp_path / "run"
    shutil.copytree(assessed / "run", folder)
    before = bytes_of(folder)
    call = ("assess", assessed / "mine", "--out", folder, "--device", "cpu")
    for reject in (0.9, 0.95):
        risks = ("--producer-risk", 0.3, "--consumer-risk", 0.3)
        answer = skyproof(*call, "--accept", 0.5, "--reject", reject, *risks)
        assert answer.code == 0
        verdict = json.loads((folder / "verdict.json").read_text())
        assert verdict["requirement"]["reject"] == reject
        assert verdict["suite"]["version"] == WHOLE.version
        assert " ".join(verdict["detectors"][0]["sentences"]) in answer.out
        assert "no verdict is possible on fewer than" in answer.out or reject == 0.95
    renewed = {"config.json", "environment.json", "timings.json", "report.html", "results.json"}
    renewed.add("steps.json")
    added = {"verdict.json", "enough.json", "open.json"}
    after = bytes_of(folder)
    assert {name for name in after if before.get(name) != after[name]} <= renewed | added
    assert added <= after.keys()


def test_a_run_ends_with_a_report_where_no_detector_can_be_accepted(
    assessed, tmp_path, skyproof: Skyproof
):
    folder = tmp_path / "run"
    shutil.copytree(assessed / "run", folder)
    for name in ("scores", "camouflages"):
        shutil.rmtree(folder / name)
    for name in ("results.json", "report.html"):
        (folder / name).unlink()
    place = folder / "detectors/retinanet/precheck.json"
    record = json.loads(place.read_text())
    record["rates"][0] |= {"easr": 0.9, "easr_low": 0.8, "easr_high": 0.95}
    place.write_text(json.dumps(record))
    call = ("assess", assessed / "mine", "--out", folder, "--device", "cpu")
    asked = ("--accept", 0.5, "--reject", 0.9, "--producer-risk", 0.3, "--consumer-risk", 0.3)
    # The same command does not go beyond the report.
    for _ in range(2):
        ended = skyproof(*call, *asked)
        assert ended.code == 0
        assert "judge the prechecks" in ended.out
        assert "RetinaNet: no verdict, because it failed the precheck: 1 of 27" in ended.out
        assert "give the same command with --go-on" in ended.out
        assert f"Report: {folder.resolve() / 'report.html'}" in ended.out
        assert "attack T-U" not in ended.out
    verdict = json.loads((folder / "verdict.json").read_text())
    assert verdict["suite"] == "incomplete"
    assert "finished" not in json.loads((folder / "environment.json").read_text())


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
    onnx = tmp_path / "best.onnx"
    onnx.write_bytes(b"")
    skyproof("assess", onnx, "--out", out).refused("best.onnx is a checkpoint", "--vehicle-classes")
    call = ("assess", onnx, "--vehicle-classes", "car", "--out", out)
    skyproof(*call, "--architecture", "fcos").refused("is an ONNX file", "leave out --architecture")
    skyproof(*call[:2], "retinanet", *call[2:]).refused("is an ONNX file", "assessed alone")
    skyproof(*call).refused("no detector in an ONNX file")
    assert not out.exists()
    for name in ("my town", "mean"):
        call = ("assess", file, "--vehicle-classes", "car", "--out", tmp_path / name)
        skyproof(*call).refused(f"'{name}' is no name for a detector", "choose another --out")
        assert not (tmp_path / name).exists()


def test_what_no_imagery_could_show_is_refused_at_once(assessed, tmp_path, skyproof: Skyproof):
    out = tmp_path / "run"
    call = ("assess", assessed / "mine", "--out", out, "--device", "cpu")
    skyproof(*call, "--accept", 0.2, "--reject", 0.3).refused(
        "takes 17 test tiles", "the suite has 6 scenes", "larger risk"
    )
    assert not out.exists()


def test_too_little_ground_for_the_risks_stops_before_anything_is_learnt(
    assessed, tmp_path, skyproof: Skyproof
):
    out = tmp_path / "run"
    call = ("assess", assessed / "mine", "--out", out, "--device", "cpu")
    # Six scenes stand on four tiles at most.
    reject = next(each / 100 for each in range(99, 0, -1) if fewest_tiles(each / 100, 0.05) == 5)
    skyproof(*call, "--accept", 0.01, "--reject", reject).refused(
        "The 6 scenes of", "on fewer than 5 no detector can be accepted", "give imagery with about"
    )
    assert not Layout(out).camouflages.exists()
    risks = ("--producer-risk", 0.3, "--consumer-risk", 0.3)
    told = skyproof(*call, "--accept", 0.01, "--reject", 0.9, *risks, "--plan")
    assert told.code == 0, told.err


def test_the_share_hidden_is_printed_by_the_main_and_the_lenient_rule(
    assessed, tmp_path, monkeypatch
):
    layout = Layout(tmp_path)
    rows = json.loads(Layout(assessed / "run").results.read_text())["rows"]
    (row,) = [each for each in rows if (each["camouflage"], each["match"]) == ("T-U", "centre_1m")]
    beside = {**row, "match": "centre_in_box", "easr": 0.02}
    said = []
    monkeypatch.setattr("skyproof.assessment.answers.say", said.append)
    for written in ([row, beside], [row]):
        write_json(layout.results, {"rows": written})
        say_answers(layout, ["T-U"])
    with_lenient, without = said
    assert with_lenient == f"{without}, by the lenient rule 2\u202f%"


@pytest.mark.parametrize(("low", "weaker"), [(-1.0, False), (1.01, True)])
def test_attacks_on_a_reference_detector_are_compared_with_what_is_expected(
    assessed, tmp_path, monkeypatch, low, weaker
):
    folder = tmp_path / "run"
    shutil.copytree(assessed / "run", folder)
    said = []
    monkeypatch.setattr("skyproof.assessment.answers.say", said.append)
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
