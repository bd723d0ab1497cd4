"""`skyproof harden` after a tiny assessment, and what it refuses."""

import base64
import io
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import tyro
from PIL import Image

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import PARENT_FILE
from skyproof.detectors.loaded import load_detector
from skyproof.files import write_json
from skyproof.hardening import harden, images
from skyproof.main import load_command
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import read_scenes
from tests.cli.conftest import Skyproof, bytes_of


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "_TILES": (1, 1, 2, 1),
        "_VEHICLES": (4, 1, 1, 1),
        "_VALIDATION_SCENES": 6,
        "_IMAGES_PER_STEP": 4,
    }.items():
        monkeypatch.setattr(harden, name, value)


@pytest.fixture
def assessed(finished: Path, tmp_path: Path) -> Path:
    """An assessment, to be changed."""
    return shutil.copytree(finished, tmp_path / "run")


def test_a_detector_is_hardened_and_can_be_assessed(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    before = bytes_of(finished)
    out = tmp_path / "hard"
    call = ("harden", finished, "--out", out, "--data", finished / "datasets/train")
    answer = skyproof(*call, "--steps", 2)
    assert answer.code == 0, answer.err
    assert "without labelled photographs" not in answer.out
    folder = out / "detectors/retinanet"
    hardened = load_detector(folder)
    parent = load_detector(finished / "detectors/retinanet")
    assert hardened.weights_sha256 != parent.weights_sha256
    assert hardened.card.training["identity"]["parent_sha256"] == parent.weights_sha256
    kept = json.loads((folder / PARENT_FILE).read_text())
    assert kept["weights_sha256"] == parent.weights_sha256
    rows = json.loads((finished / "results.json").read_text())["rows"]
    wanted = {
        row["camouflage"]: row["easr"]
        for row in rows
        if row["match"] == "centre_1m"
        if not row["camouflage"].startswith("R-") or row["camouflage"].endswith("_pattern")
    }
    assert wanted.keys() == {"T-U", "T-PixFcMa", "R-U_pattern", "R-Ma_pattern"}
    assert {name: own["frozen"]["hidden"][0] for name, own in kept["rates"].items()} == wanted
    scores = finished / "scores/test-0/pairs"
    (pair,) = [
        each
        for each in json.loads((scores / "pairs.json").read_text())["rows"]
        if each["camouflage"] == "T-U"
    ][:1]
    picture = base64.b64decode(kept["pictures"]["T-U"].removeprefix("data:image/jpeg;base64,"))
    # The picture as it was drawn, reduced to 400 px.
    with (
        Image.open(io.BytesIO(picture)) as small,
        Image.open(scores / pair["adversarial"]) as whole,
    ):
        assert small.size == (min(400, whole.width), min(400, whole.height))
        difference = np.asarray(whole.resize(small.size), float) - np.asarray(small, float)
    assert np.abs(difference).mean() < 8
    assert "draws other scenes than this run" not in answer.out
    (told,) = re.findall(r"Assess it anew: skyproof (.*)", answer.out)
    command, *words = shlex.split(told)
    request = tyro.cli(load_command(command), args=words, console_outputs=False)
    assert request.detectors == (folder,)
    # The parent is as it was, and the same call does nothing again.
    assert bytes_of(finished) == before
    made = bytes_of(out)
    assert skyproof(*call, "--steps", 2).code == 0
    assert bytes_of(out) == made
    skyproof(*call, "--steps", 3).refused("other settings", "another --out")


def test_without_photographs_that_is_said(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    answer = skyproof("harden", finished, "--out", tmp_path / "hard", "--steps", 1)
    assert answer.code == 0, answer.err
    assert "without labelled photographs (--data) it may find fewer vehicles on them" in answer.out
    # AP is that of renders, which do not show the price on photographs.
    card = load_detector(tmp_path / "hard/detectors/retinanet").card
    assert card.training["trained_share"] in (0.5, 0.25)
    assert card.training["identity"]["shares"] == [0.5, 0.25]


def test_with_labels_as_much_of_the_trained_weights_stays_as_their_ap_allows(
    assessed: Path, skyproof: Skyproof
) -> None:
    config = json.loads((assessed / "config.json").read_text())
    write_json(assessed / "config.json", {**config, "labels": "labels.geojson"})
    for split in ("attack", "validation"):
        shutil.copytree(assessed / "datasets/validation", assessed / "tiles" / split)
    answer = skyproof("harden", assessed, "--out", assessed.parent / "hard", "--steps", 1)
    assert answer.code == 0, answer.err
    card = load_detector(assessed.parent / "hard/detectors/retinanet").card
    assert card.training["identity"]["shares"] == [1.0, 0.75, 0.5, 0.25]


def test_the_run_itself_is_no_place_for_the_result(assessed: Path, skyproof: Skyproof) -> None:
    before = bytes_of(assessed)
    skyproof("harden", assessed, "--out", assessed).refused("--out expects another folder")
    assert bytes_of(assessed) == before


def test_after_another_suite_both_are_to_be_assessed(assessed: Path, skyproof: Skyproof) -> None:
    config = json.loads((assessed / "config.json").read_text())
    suite = {**config["suite"], "sha256": "0" * 64}
    write_json(assessed / "config.json", {**config, "suite": suite})
    answer = skyproof("harden", assessed, "--out", assessed.parent / "hard", "--steps", 1)
    assert answer.code == 0, answer.err
    assert "draws other scenes than this run" in answer.out


@pytest.mark.parametrize("changes", [{"suite": None}, {"names": ["retinanet", "faster_rcnn"]}])
def test_a_run_of_something_else_is_refused(
    assessed: Path, skyproof: Skyproof, changes: dict[str, object]
) -> None:
    config = json.loads((assessed / "config.json").read_text())
    write_json(assessed / "config.json", {**config, **changes})
    answer = skyproof("harden", assessed, "--out", assessed.parent / "hard")
    answer.refused("no assessment of a single detector", "skyproof assess")
    assert not (assessed.parent / "hard").exists()


def test_photographs_of_another_resolution_are_refused(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    data = shutil.copytree(finished / "datasets/train", tmp_path / "coarse")
    document = json.loads((data / "annotations.json").read_text())
    write_json(data / "annotations.json", {**document, "info": {**document["info"], "gsd_m": 0.3}})
    answer = skyproof("harden", finished, "--data", data, "--out", tmp_path / "hard")
    answer.refused(str(data), "not of 0.125 m per pixel", "resample it")
    assert not (tmp_path / "hard").exists()


@pytest.fixture
def of_answers(assessed: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An assessment of a detector of which only the answers are known, as of a callable."""
    monkeypatch.setattr(images, "_PAINTED", 10)
    monkeypatch.setattr(images, "_CAMOUFLAGED", 4)
    monkeypatch.setattr(harden, "strongest", lambda results: ["T-U", "R-U_plain"])
    place = assessed / "detectors/retinanet/detector.json"
    write_json(place, {**json.loads(place.read_text()), "size": ""})
    return assessed


def test_for_a_detector_that_is_trained_elsewhere_images_are_rendered(
    of_answers: Path, skyproof: Skyproof
) -> None:
    before, out = bytes_of(of_answers), of_answers.parent / "hard"
    answer = skyproof("harden", of_answers, "--out", out)
    assert answer.code == 0, answer.err
    assert f"skyproof cannot train retinanet. Add the images of {out / 'datasets'}" in answer.out
    assert bytes_of(of_answers) == before
    made = {folder.name: Dataset.open(folder) for folder in (out / "datasets").iterdir()}
    counts = {name: len(each) for name, each in made.items()}
    assert counts == {"T-U": 2, "R-U_plain": 2, "paints": 10}
    for name, each in made.items():
        assert (each.folder / "data.yaml").exists()
        assert len([*(each.folder / "labels").glob("*.txt")]) == len(each)
        worn = json.loads((each.folder / "annotations.json").read_text())["info"]
        assert ("camouflage" in worn) == (name != "paints")
    # They can be put into one folder.
    assert len({path.name for path in out.glob("datasets/*/images/*")}) == 14
    # The ground is not that of the test.
    scenes = read_scenes(out / "datasets/paints/scenes.jsonl")
    tiles = {scene.background.tile for scene in scenes}
    assert tiles <= {tile.id for tile in BackgroundSet.open(out / "backgrounds").tiles("attack")}
    # Some vehicles are cut by the image's edge.
    reaches_m = [
        scene.camera.size_px * scene.camera.gsd_m / 2 - max(abs(at.x_m), abs(at.y_m))
        for scene in scenes
        for at in scene.placements
    ]
    assert min(reaches_m) < 1.9
    shutil.rmtree(out / "datasets/T-U")
    finished = bytes_of(out / "datasets/paints")
    assert skyproof("harden", of_answers, "--out", out).code == 0
    assert len(Dataset.open(out / "datasets/T-U")) == 2
    assert bytes_of(out / "datasets/paints") == finished
    # Images of another run are neither mixed nor taken for those of this one.
    again = ("harden", of_answers, "--out", out)
    skyproof(*again, "--seed", 1).refused("images of another assessment or seed", "another --out")
    results = of_answers / "results.json"
    results.write_bytes(results.read_bytes() + b"\n")
    skyproof(*again).refused("images of another assessment or seed", "another --out")


@pytest.mark.parametrize("option", [("--steps", 3), ("--data", "nowhere")])
def test_options_that_render_nothing_are_refused(
    of_answers: Path, skyproof: Skyproof, option: tuple[str, object]
) -> None:
    out = of_answers.parent / "hard"
    skyproof("harden", of_answers, "--out", out, *option).refused("leave out --data and --steps")
    assert not out.exists()
    skyproof("harden", of_answers, "--out", of_answers).refused("--out expects another folder")
    out.mkdir()
    (out / "other").touch()
    skyproof("harden", of_answers, "--out", out).refused(str(out), "--out")


def test_where_nothing_surely_hides_there_is_nothing_to_render(
    assessed: Path, skyproof: Skyproof
) -> None:
    place = assessed / "detectors/retinanet/detector.json"
    write_json(place, {**json.loads(place.read_text()), "size": ""})
    shutil.rmtree(assessed / "camouflages")
    answer = skyproof("harden", assessed, "--out", assessed.parent / "hard")
    answer.refused("surely hides", "nothing to harden against")
    assert not (assessed.parent / "hard").exists()


def test_a_folder_that_is_no_assessment_is_refused(assessed: Path, skyproof: Skyproof) -> None:
    skyproof("harden", assessed.parent / "none", "--out", assessed.parent / "hard").refused(
        "none", "give a run of skyproof assess"
    )
    assert not (assessed.parent / "hard").exists()


def test_an_assessment_that_was_stopped_is_refused(assessed: Path, skyproof: Skyproof) -> None:
    (assessed / "results.json").unlink()
    answer = skyproof("harden", assessed, "--out", assessed.parent / "hard")
    answer.refused(f"{assessed} is not finished", "skyproof assess again")
    assert not (assessed.parent / "hard").exists()
