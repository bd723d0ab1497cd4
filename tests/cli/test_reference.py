"""Detectors that come trained: copied by a command, attacked by the demo, refused if damaged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skyproof.detectors import reference_detectors
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, REFERENCE_FOLDER
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.main import run
from skyproof.results.precheck import read_precheck
from skyproof.scenes.splits import SPLITS
from tests.cli.conftest import CHOSEN, TINY, UNTRAINED, Skyproof, bytes_of

FILES = {"precheck.json", "detector.json", "weights.safetensors"}


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished tiny run on detectors that come trained; not to be changed."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    assert run(["demo", "--out", str(folder), *UNTRAINED]) == 0
    return folder


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of what comes with skyproof, in its place."""
    folder = Path(shutil.copytree(REFERENCE_FOLDER, tmp_path / "came"))
    monkeypatch.setattr(reference_detectors, "REFERENCE_FOLDER", folder)
    return folder


def test_the_demo_attacks_them_and_trains_nothing(attacked: Path) -> None:
    rows = json.loads((attacked / "results.json").read_text())["rows"]
    assert {row["detector"] for row in rows} == {*REFERENCE_DETECTORS, "mean"}
    learnt = {"T-U", "R-U", "T-PixFcMa", "R-PixFcMa"}
    assert {row["camouflage"] for row in rows} == {*learnt, *CHOSEN}
    clean = [row["ap_original"] for row in rows if row["match"] == "centre_1m"]
    assert min(clean) > 0.5
    for name in REFERENCE_DETECTORS:
        assert bytes_of(attacked / "detectors" / name) == bytes_of(REFERENCE_FOLDER / name)
    assert [path.name for path in (attacked / "datasets").iterdir()] == ["test"]
    times = json.loads((attacked / "timings.json").read_text())
    assert not {"train", "check"} & {row["stage"] for row in times}


def test_the_report_says_that_they_were_checked_before(attacked: Path) -> None:
    page = (attacked / "report.html").read_text()
    scenes = read_precheck(REFERENCE_FOLDER / "retinanet").measured_on.scenes
    told = (
        f"RetinaNet and Faster R-CNN were checked before, on {scenes} scenes of procedural ground, "
        "and not on the scenes of this run."
    )
    assert page.count(told) == 1
    assert "are the detectors worth attacking?" in page
    assert "was not checked" not in page


def test_given_again_it_is_finished_and_training_is_another_run(
    attacked: Path, skyproof: Skyproof
) -> None:
    before = bytes_of(attacked)
    for more in ([], ["--detectors", *REFERENCE_DETECTORS]):
        assert "finished" in skyproof("demo", "--out", attacked, *UNTRAINED, *more).out
    skyproof("demo", "--out", attacked, *UNTRAINED, "--train").refused("train", "another --out")
    assert bytes_of(attacked) == before


def test_a_demo_of_before_had_trained(copied: Callable[..., Path], skyproof: Skyproof) -> None:
    """It goes on with --train, and is no run of detectors that come trained."""
    folder = copied("report.html")
    config = json.loads((folder / "config.json").read_text())
    del config["train"]
    (folder / "config.json").write_text(json.dumps(config))
    before = bytes_of(folder)
    skyproof("demo", "--out", folder, *UNTRAINED, "--detectors", "retinanet").refused(
        str(folder), "train", "another --out"
    )
    assert bytes_of(folder) == before
    said = skyproof("demo", "--out", folder, *TINY)
    assert said.code == 0, said.err
    assert "train retinanet" not in said.out
    assert (folder / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--detectors", "yolov5"], ("'yolov5' does not come trained", "skyproof demo --train")),
        (["--detectors", "retinanet", "retinanet"], ("each detector once",)),
        (["--training.steps", "5"], ("--training says", "give --train too")),
        (["--sizes.training-images", "8"], ("--sizes.training-images says", "--train too")),
        (["--sizes.paints.plain", "0.1"], ("--sizes.paints says", "give --train too")),
    ],
)
def test_what_needs_training_is_refused_without_it(
    tmp_path: Path, skyproof: Skyproof, words: list[str], told: tuple[str, ...]
) -> None:
    skyproof("demo", "--out", tmp_path / "run", *UNTRAINED, *words).refused(*told)
    assert not (tmp_path / "run").exists()


def test_on_imagery_of_the_users_they_are_checked_there(tmp_path: Path, skyproof: Skyproof) -> None:
    drawn = write_procedural_backgrounds(tmp_path / "drawn", {"test": 1}, 680, seed=1)
    photo = tmp_path / "photo.png"
    shutil.copy(drawn.folder / drawn.tiles("test")[0].file, photo)
    call = ["demo", "--out", tmp_path / "run", *UNTRAINED, "--imagery", photo, "--gsd", 0.125]
    call += ["--detectors", "retinanet", "--sizes.check-scenes", 2]
    answer = skyproof(*call)
    assert answer.code == 0, answer.err
    record = read_precheck(tmp_path / "run" / "detectors" / "retinanet")
    assert record.measured_on.sources == ("photo.png",)
    assert record.measured_on.scenes == 2
    assert "RetinaNet: " in answer.out
    assert "checked before" not in (tmp_path / "run" / "report.html").read_text()


def test_the_command_copies_them_whole_and_overwrites_nothing(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    answer = skyproof("reference", "--out", tmp_path / "both")
    assert answer.code == 0, answer.err
    assert answer.out.count("plain paints on body panels") == 2
    assert bytes_of(tmp_path / "both") == {
        f"{name}/{file}": (REFERENCE_FOLDER / name / file).read_bytes()
        for name in REFERENCE_DETECTORS
        for file in FILES
    }
    one = ["reference", "--out", tmp_path / "one", "--detectors", "faster_rcnn"]
    assert "plain paints" not in skyproof(*one, "--no-check").out
    assert set(bytes_of(tmp_path / "one")) == {
        f"faster_rcnn/{file}" for file in FILES - {"precheck.json"}
    }
    # The second detector is in the way, and the first is not written either.
    skyproof("reference", "--out", tmp_path / "one").refused("faster_rcnn", "not overwritten")
    assert not (tmp_path / "one" / "retinanet").exists()


def test_an_empty_folder_as_snakemake_makes_it_is_not_in_the_way(
    tmp_path: Path, skyproof: Skyproof
) -> None:
    (tmp_path / "detectors" / "retinanet").mkdir(parents=True)
    (tmp_path / "detectors" / "faster_rcnn").mkdir()
    (tmp_path / "detectors" / "faster_rcnn" / "mine.txt").touch()
    call = ["reference", "--out", tmp_path / "detectors", "--detectors"]
    assert skyproof(*call, "retinanet").code == 0
    assert (tmp_path / "detectors" / "retinanet" / "detector.json").exists()
    skyproof(*call, "faster_rcnn").refused("faster_rcnn", "not overwritten")


def test_names_that_do_not_come_trained(tmp_path: Path, skyproof: Skyproof) -> None:
    for names in (["yolov5"], ["retinanet", "../x"], []):
        skyproof("reference", "--out", tmp_path / "out", "--detectors", *names).refused(
            *names[-1:], "retinanet"
        )
    assert not (tmp_path / "out").exists()


def _halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


def _of_another_version(path: Path) -> None:
    card = path.with_name("detector.json")
    card.write_text(json.dumps({**json.loads(card.read_text()), "format": 2}))


def _of_another_network(path: Path) -> None:
    shutil.copy(path.parents[1] / "faster_rcnn" / path.name, path)


def _torn_check(path: Path) -> None:
    path.with_name("precheck.json").write_text("{")


def _changed(path: Path) -> None:
    data = np.fromfile(path, np.uint8)
    data[-1] ^= 1
    data.tofile(path)


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (_halved, "weights.safetensors is damaged"),
        (Path.unlink, "weights.safetensors is missing"),
        (_of_another_version, "format 2"),
        (_of_another_network, "does not fit a slim retinanet"),
        (_changed, "not the file that detector.json was written for"),
        (_torn_check, "precheck.json"),
    ],
)
def test_damaged_or_of_another_version_is_one_sentence(
    elsewhere: Path, tmp_path: Path, skyproof: Skyproof, harm: Callable[[Path], None], told: str
) -> None:
    harm(elsewhere / "retinanet" / "weights.safetensors")
    remedy = "copy the whole folder again" if harm is _torn_check else "install skyproof again"
    skyproof("reference", "--out", tmp_path / "out").refused(told, remedy)
    assert not (tmp_path / "out").exists()
    skyproof("demo", "--out", tmp_path / "run", *UNTRAINED).refused(told, remedy)
    assert not (tmp_path / "run" / "backgrounds").exists()


def test_there_is_ground_to_attack_and_test_on_and_next_to_none_to_learn_from(
    attacked: Path,
) -> None:
    index = json.loads((attacked / "backgrounds" / "index.json").read_text())
    splits = [tile["split"] for tile in index["tiles"]]
    assert [splits.count(name) for name in SPLITS] == [1, 1, 2, 3]
    assert len(list((attacked / "datasets" / "test" / "images").iterdir())) == 6
