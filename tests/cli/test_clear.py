"""`skyproof clear`: from the command line, and what it refuses."""

import json
import shutil

import pytest

from skyproof.detectors.card import reference_folder
from skyproof.imagery.words import light_words, warnings
from skyproof.scenes.backgrounds import BackgroundSet
from tests.cli.conftest import Skyproof
from tests.imagery.test_clear import tiled


def test_a_folder_is_cleared_and_tiles_are_dropped(tmp_path, skyproof: Skyproof):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    answer = skyproof("clear", folder, "--out", tmp_path / "cleared")
    assert answer.code == 0
    assert "5 of 5 kept" in answer.out
    assert "Not checked by a detector" in answer.out
    assert "Where the sun stood over 1 of 1 sources is not known" in answer.out
    image = BackgroundSet.open(tmp_path / "cleared").pixels("c").int()
    assert (image[0] - image[1]).max() < 30
    assert skyproof("clear", tmp_path / "cleared", "--reject", "c").code == 0
    assert BackgroundSet.open(tmp_path / "cleared").tiles("validation") == []


def test_it_says_what_was_done_about_the_sun_of_how_many_sources():
    low, high = {"elevation_rad": 0.5}, {"elevation_rad": 0.6}
    record = {
        "suns": {"a": low, "b": low, "c": high, "dated": low},
        "overcast": ["dated", "e"],
        "photographs": 6,
    }
    assert [*light_words(record)] == [
        "Sun known over 3 of 6 sources, 29 to 34 degrees high: vehicles will stand in it.",
        "Overcast: over 2 of 6 sources the shadows of vehicles end softly, so vehicles will be "
        "drawn in the sky's light alone.",
        "Where the sun stood over 1 of 6 sources is not known (too few vehicles with clear "
        "shadows on even ground): scenes will draw any sun.",
    ]


@pytest.mark.parametrize(
    ("labelled", "detected", "share", "vehicles_from", "words"),
    [
        (130, 391, 0.05, ["labels", "d"], ["391 removed vehicles were only found by the detector"]),
        (130, 390, 0.10, ["labels", "d"], []),
        (0, 500, 0.02, ["d"], []),
        (130, 872, 0.17, ["labels", "d"], ["872 removed vehicles", "17% of the ground was filled"]),
    ],
)
def test_it_warns_where_ground_was_smeared(labelled, detected, share, vehicles_from, words):
    totals = {"labelled_removed": labelled, "detected_removed": detected, "masked_share": share}
    found = [*warnings(totals, vehicles_from)]
    assert len(found) == len(words)
    assert all(word in sentence for word, sentence in zip(words, found, strict=True))


def test_a_detector_that_failed_its_check_certifies_nothing(tmp_path, skyproof: Skyproof):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    detector = tmp_path / "detector"
    shutil.copytree(reference_folder("retinanet"), detector)
    call = ("clear", folder, "--detector", detector, "--device", "cpu")
    check = json.loads((detector / "precheck.json").read_text())
    # As if nothing but random controls surely hid vehicles from it.
    for rate in check["rates"]:
        if rate["kind"] != "control":
            rate["easr_low"] = min(rate["easr_low"], 0.0)
    (detector / "precheck.json").write_text(json.dumps(check))
    answer = skyproof(*call, "--out", tmp_path / "good")
    assert answer.code == 0
    assert "Not checked by a detector" not in answer.out
    check["sets"][0]["ap_centre_1m"] = check["sets"][0]["ap_centre_1m_high"] = 0.4
    check["sets"][0]["ap_centre_1m_low"] = 0.3
    (detector / "precheck.json").write_text(json.dumps(check))
    answer = skyproof(*call, "--out", tmp_path / "cleared")
    assert answer.code == 0
    assert "failed its precheck" in answer.out
    assert "Not checked by a detector" in answer.out
    record = json.loads((tmp_path / "cleared" / "clearing.json").read_text())
    assert record["checked_by"] == "not checked by a detector"


def test_what_cannot_work_is_one_sentence(tmp_path, skyproof: Skyproof):
    folder, out = tiled(tmp_path / "tiled"), tmp_path / "cleared"
    (tmp_path / "plain").mkdir()

    def refused(*words, text):
        skyproof("clear", *words).refused(text)
        assert not out.exists()
        assert not (tmp_path / ".cleared.partial").exists()

    refused(tmp_path / "plain", "--out", out, text="index.json is missing")
    refused(folder, "--out", out, "--detector", tmp_path / "plain", text="detector.json is missing")
    refused(folder, "--out", out, text="no detector was given")
    refused(folder, text="--out with a folder to write, or --reject")
    refused(folder, "--out", out, "--reject", "a", text="got both")
    refused(folder, "--reject", "x", text="no tile 'x'")
    refused(tmp_path / "plain", "--reject", "a", text="index.json is missing")
    out.mkdir()
    skyproof("clear", folder, "--out", out).refused("exists already")


def test_scenes_have_vehicles_where_others_were_removed(tmp_path, skyproof: Skyproof):
    folder, ground = tiled(tmp_path / "tiled", labelled="acde"), tmp_path / "cleared"
    answer = skyproof("clear", folder, "--out", ground)
    assert "places of 5 are kept for skyproof render --settings.places removed" in answer.out
    fleets = tmp_path / "fleets"
    assert skyproof("vehicles", "--counts", 3, 1, 1, 1, "--out", fleets).code == 0

    def scenes(ground, places, name):
        words = ["render", "--backgrounds", ground, "--fleet", fleets / "train", "--count", 6]
        words += ["--split", "train", "--settings.size-px", 80, "--settings.vehicles-maximum", 2]
        return skyproof(*words, "--settings.places", places, "--out", tmp_path / name)

    assert scenes(ground, "removed", "removed").code == 0
    assert scenes(ground, "drivable", "drivable").code == 0
    for name in ("removed", "drivable"):
        rows = map(json.loads, (tmp_path / name / "scenes.jsonl").read_text().splitlines())
        # Tile b has neither vehicles nor, by its labels, ground for them.
        assert {row["background"]["tile"] for row in rows} == {"a"}
    assert scenes(ground, "uniform", "uniform").code == 0
    rows = map(json.loads, (tmp_path / "uniform" / "scenes.jsonl").read_text().splitlines())
    assert {row["background"]["tile"] for row in rows} == {"a", "b"}
    scenes(folder, "removed", "no").refused("knows no removed vehicles on its train tiles")
    refused = scenes(ground, "roofs", "no")
    assert refused.code == 2
    assert "'--settings.places'" in refused.err
    # A place outside its tile.
    index = json.loads((ground / "index.json").read_text())
    index["tiles"][0]["removed"][0]["x_px"] = 400.0
    (ground / "index.json").write_text(json.dumps(index))
    scenes(ground, "removed", "no").refused("outside the tile a of 120 x 120 px")
    assert not (tmp_path / "no").exists()
