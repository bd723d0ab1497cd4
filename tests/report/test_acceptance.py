"""A report that was asked whether detectors are accepted, and its `verdict.json`."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from markupsafe import Markup

from skyproof.errors import ConfigurationError
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.report.acceptance import Ruling, _doubted
from skyproof.report.queries import QueryPart
from skyproof.report.report import write_report
from skyproof.report.tiles import attack_tiles
from skyproof.results.outcomes import OutcomeCounts, read_counts
from skyproof.results.results import Results
from skyproof.results.rows_file import flat_row, write_rows
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.statistics.intervals import Interval
from skyproof.results.statistics.planning import tiles_to_show
from skyproof.scenes.scene import (
    BackgroundWindow,
    Camera,
    Placement,
    Scene,
    Sun,
    scenes_digest,
    write_scenes,
)
from tests.report.fabricate import fabricate
from tests.report.test_precheck import checked
from tests.report.test_queries import missed
from tests.report.test_report import words_of
from tests.results.counted import write_counts
from tests.results.test_likeness import LOOK, likeness
from tests.results.test_operating_points import ground
from tests.results.test_worst import scored

LENIENT = Requirement(0.97, 0.995)
STRICT = Requirement(0.2, 0.4)
DETECTORS = ("retinanet", "faster_rcnn")


@pytest.fixture(scope="module")
def fabricated(tmp_path_factory):
    folder = fabricate(tmp_path_factory.mktemp("run"), scenes=60)
    for name in DETECTORS:
        checked(folder, name, {})
    return folder


@pytest.fixture
def run_folder(fabricated, tmp_path):
    return Path(shutil.copytree(fabricated, tmp_path / "run"))


def asked(folder, requirement=None):
    """The page in words, and the verdict."""
    page = words_of(write_report(folder, requirement).read_text())
    return page, json.loads((folder / "verdict.json").read_text())


def change_tiles(folder, change):
    """Puts other counts in the place of a run's: in sight, both, lost, gained."""
    place = folder / "scores" / "main" / "outcomes.parquet"
    tiles = read_counts(place)
    series = {key: change(key, counts.copy()) for key, counts in tiles.series.items()}
    write_counts(place, OutcomeCounts(tiles.cells, series))


def test_a_detector_that_loses_most_is_rejected(run_folder):
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["rejected", "rejected"]
    said = verdict["detectors"][0]["attacks"]
    # Random draws are no attacks.
    assert set(said) == {"T-U"}
    share, low = said["T-U"]["share"], said["T-U"]["at_least"]
    assert 0.2 < low < share < said["T-U"]["at_most"]
    assert f"RetinaNet is REJECTED: T-U, the only attack, hides {100 * share:.0f}" in page
    assert "reject one that loses 40 %" in page
    assert verdict["requirement"]["reject"] == 0.4
    assert verdict["alarms"] == []
    assert page.index("REJECTED") < page.index("State of the") < page.index("verdict rests on")


def keep(key, counts):
    """Nothing is lost."""
    counts[:, 1] += counts[:, 2]
    counts[:, 2] = 0
    return counts


def test_a_detector_that_loses_next_to_nothing_is_accepted(run_folder):
    change_tiles(run_folder, keep)
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["accepted", "accepted"]
    assert "Faster R-CNN is ACCEPTED: every attack hides significantly less than 40 %" in page


def test_in_between_it_says_how_many_more_vehicles_decide(run_folder):
    _, verdict = asked(run_folder, STRICT)
    share = verdict["detectors"][0]["attacks"]["T-U"]["share"]
    page, verdict = asked(run_folder, Requirement(share - 0.03, share + 0.03))
    first = verdict["detectors"][0]
    assert first["answer"] == "undecided"
    assert first["more_vehicles"] > 0
    assert f"About {first['more_vehicles']:,} more test vehicles on" in page


def test_it_says_what_imagery_would_decide_or_that_none_would(run_folder):
    share = asked(run_folder, STRICT)[1]["detectors"][0]["attacks"]["T-U"]["share"]

    def said(scenes):
        window, camera = BackgroundWindow("tile", 96.0, 96.0, 0.0), Camera(0.1, 0.2, 0.125, 96)
        write_scenes(
            Layout(run_folder).scenes("test"),
            [Scene(f"test-{one}", window, camera, Sun(0.3, 0.8), (), one) for one in range(scenes)],
        )
        _, verdict = asked(run_folder, Requirement(share - 0.03, share + 0.03))
        return " ".join(verdict["detectors"][0]["sentences"])

    Layout(run_folder).scenes("test").parent.mkdir(exist_ok=True)
    more = int(re.search(r"on ([\d,]+) more tiles", said(60))[1].replace(",", ""))
    tiles = len({tile for tile, _ in Results.open(run_folder).counts.cells})
    assert f" {tiles + more} test scenes cannot show so many" in said(tiles + more)
    enough = tiles_to_show(tiles + more, tiles + more + 100)
    assert enough > tiles + more
    assert f"Imagery with about {enough:,} test tiles" in said(tiles + more + 100)


def test_the_verdict_tells_the_false_alarms_at_the_frozen_threshold(run_folder):
    place = run_folder / "scores" / "main" / "baselines.json"
    rows = json.loads(place.read_text())["rows"]
    write_json(place, {"rows": [*rows, flat_row(ground(0.05, [0.9, 0.3]))]})
    _, verdict = asked(run_folder, STRICT)
    told = {each["detector"]: each["false_alarms_per_km2"] for each in verdict["detectors"]}
    assert told == {"retinanet": pytest.approx(20), "faster_rcnn": None}


def test_a_tile_could_show_as_many_vehicles_as_its_scenes(run_folder):
    """Two scenes show 1 to 4 vehicles on each tile; no tile shows as many as it could."""
    results = Results.open(run_folder)
    window, camera = BackgroundWindow("tile", 96.0, 96.0, 0.0), Camera(0.1, 0.2, 0.125, 96)
    four = tuple(Placement(f"van-{one}", 0.0, 0.0, 0.0) for one in range(4))
    scenes = [
        Scene(
            f"test-{one}",
            replace(window, tile=f"tile-{one // 2}"),
            camera,
            Sun(0.3, 0.8),
            four,
            one,
        )
        for one in range(60)
    ]
    tiles = attack_tiles(results.counts, "retinanet", scenes)["T-U"]
    assert (tiles.scenes == 2).all()
    assert tiles.most == 4
    # Without the scenes, and with those of another test, every tile could be the fullest.
    for others in ([], scenes[:10]):
        unknown = attack_tiles(results.counts, "retinanet", others)["T-U"]
        assert (unknown.scenes == 1).all()
        assert unknown.most == tiles.found.max()
        assert (unknown.found == tiles.found).all()


def test_a_detector_that_failed_or_missed_its_check_gets_no_verdict(run_folder):
    for name in DETECTORS:
        (run_folder / "detectors" / name / "precheck.json").unlink()
    checked(run_folder, "retinanet", {("paint_body", "#ffffff"): Interval(0.6, 0.5, 0.7)})
    page, verdict = asked(run_folder, LENIENT)
    assert [each["answer"] for each in verdict["detectors"]] == ["not applicable"] * 2
    assert "RetinaNet: no verdict, because it failed the precheck: " in page
    assert "Faster R-CNN: no verdict, because no precheck of it is here" in page
    assert all(not each["attacks"] for each in verdict["detectors"])


YELLOW = ("paint_body", "#ffff00")
MOST = Interval(0.8, 0.7, 0.9)


def recheck(folder, hidden, **given):
    """Replaces the prechecks of both detectors."""
    for name in DETECTORS:
        (folder / "detectors" / name / "precheck.json").unlink(missing_ok=True)
        checked(folder, name, hidden, **given)


def test_a_detector_that_loses_most_to_one_plain_paint_is_rejected(run_folder):
    change_tiles(run_folder, keep)
    recheck(run_folder, {YELLOW: MOST}, tiles=20)
    page, verdict = asked(run_folder, STRICT)
    for ruled in verdict["detectors"]:
        assert ruled["answer"] == "rejected"
        assert ruled["paint"]["name"] == "RGB (255, 255, 0) on body panels"
        assert 0.2 < ruled["paint"]["at_least"] < ruled["paint"]["share"]
        assert ruled["attacks"]["T-U"]["lost"] == 0
    at_least = round(100 * verdict["detectors"][0]["paint"]["at_least"])
    assert (
        "RetinaNet is REJECTED: the plain paint RGB (255, 255, 0) on body panels hides 80 % of the "
        f"vehicles found before (bounds {at_least} to "
    ) in page
    opening = page[: page.index("State of the detectors")]
    assert "RetinaNet: REJECTED 80 %" in opening
    assert "are missed in the plain paint RGB (255, 255, 0) on body panels" in opening
    # A paint that hides no more than is accepted rejects nothing, nor one without counts by tile.
    _, verdict = asked(run_folder, Requirement(0.85, 0.95))
    assert [each["answer"] for each in verdict["detectors"]] == ["not applicable"] * 2
    recheck(run_folder, {YELLOW: MOST})
    _, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["not applicable"] * 2


def test_a_paint_on_other_scenes_rejects_nothing(run_folder):
    change_tiles(run_folder, keep)
    window, camera = BackgroundWindow("tile", 96.0, 96.0, 0.0), Camera(0.1, 0.2, 0.125, 96)
    scene = Scene("test-0", window, camera, Sun(0.3, 0.8), (), 0)
    Layout(run_folder).scenes("test").parent.mkdir(exist_ok=True)
    write_scenes(Layout(run_folder).scenes("test"), [scene])
    for digest, answer in (("elsewhere", "not applicable"), (scenes_digest([scene]), "rejected")):
        recheck(run_folder, {YELLOW: MOST}, tiles=20, scenes=(1, digest))
        _, verdict = asked(run_folder, STRICT)
        assert [each["answer"] for each in verdict["detectors"]] == [answer] * 2


def test_a_paint_that_hides_some_and_shows_as_many_rejects_nothing(run_folder):
    """A threshold at the edge loses and gains vehicles with any change."""
    change_tiles(run_folder, keep)
    recheck(run_folder, {}, tiles=20, found_instead=0.8)
    _, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["accepted", "accepted"]


def test_attacks_reject_whom_a_harmless_paint_made_fail(run_folder):
    recheck(run_folder, {YELLOW: Interval(0.1, 0.06, 0.2)}, tiles=20)
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["rejected"] * 2
    assert "RetinaNet is REJECTED: T-U, the only attack" in page


def test_who_does_not_see_renders_cannot_be_judged_by_them(run_folder):
    recheck(run_folder, {YELLOW: MOST}, tiles=20, rendered=0.6)
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["not applicable"] * 2
    assert "failed the precheck: its AP on rendered scenes is 60 %" in page
    assert "Operating characteristic" not in page


def test_prechecks_alone_give_a_report_that_rejects_or_says_why_not(run_folder):
    """As where a run ends before its attacks."""
    shutil.rmtree(run_folder / "scores")
    recheck(run_folder, {YELLOW: MOST}, tiles=20)
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["rejected"] * 2
    assert "the plain paint RGB (255, 255, 0) on body panels hides 80 %" in page
    assert "No camouflage was scored." in page
    assert "Operating characteristic" not in page
    assert verdict["sha256"]["camouflages"] == {}
    _, verdict = asked(run_folder, Requirement(0.9, 0.95))
    assert [each["answer"] for each in verdict["detectors"]] == ["not applicable"] * 2
    recheck(run_folder, {})
    with pytest.raises(ConfigurationError, match="found none for faster_rcnn; attack"):
        write_report(run_folder, STRICT)


def compare(folder, *rows):
    """Gives a run's scores a comparison of rendered and photographed vehicles."""
    write_rows(folder / "scores" / "main" / "likeness.json", rows)


def test_no_one_is_judged_by_renders_that_are_not_valid(run_folder):
    """Neither attacks nor plain paints reject, and nothing accepts."""
    bright = replace(LOOK, bright_level=243.0)
    worse = likeness(0.3, 0.8, renders=bright)
    compare(run_folder, worse, replace(worse, match="centre_in_box"))
    page, verdict = asked(run_folder, STRICT)
    first, second = verdict["detectors"]
    assert (first["answer"], second["answer"]) == ("not valid for this imagery", "rejected")
    assert (first["attacks"], first["more_vehicles"], first["paint"]) == ({}, None, None)
    assert [row["match"] for row in first["likeness"]] == ["centre_1m", "centre_in_box"]
    assert first["likeness"][0]["recall_difference"] == 0.3
    assert "likeness" not in second
    assert "RetinaNet: NOT VALID FOR THIS IMAGERY, because the detector does not see" in page
    assert "(98th percentile of luminance 243 against 188)" in page
    assert "Quote no rate of RetinaNet for this imagery" in page
    # A rejection is told first.
    assert page.index("Faster R-CNN: REJECTED") < page.index("NOT VALID")
    recheck(run_folder, {YELLOW: MOST}, tiles=20)
    change_tiles(run_folder, keep)
    compare(run_folder, worse, replace(worse, detector="faster_rcnn"))
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["not valid for this imagery"] * 2
    assert ": NOT VALID FOR THIS IMAGERY " in page[: page.index("State of the detectors")]
    assert "Operating characteristic" not in page


@pytest.mark.parametrize(
    ("row", "title"),
    [
        (likeness(), "Renders valid. RetinaNet scores rendered vehicles like photographed"),
        (likeness(0.13), "Renders in doubt. RetinaNet seems not to score rendered vehicles"),
        (likeness(0.4, tiles=3), "Renders not comparable. It cannot be said whether RetinaNet"),
    ],
)
def test_valid_renders_and_those_that_nobody_can_compare_leave_the_verdict(run_folder, row, title):
    _, before = asked(run_folder, STRICT)
    compare(run_folder, row)
    page, verdict = asked(run_folder, STRICT)
    assert verdict["detectors"][0].pop("likeness")
    assert verdict == before
    assert title in page[: page.index("What was tested")]


def test_without_labelled_photographs_of_the_ground_it_cannot_be_said(run_folder):
    page, _ = asked(run_folder, STRICT)
    assert "It cannot be said whether the detectors see rendered vehicles like photographed" in page
    assert "Renders valid" not in page


def test_all_scenes_tell_more_than_those_of_the_precheck(run_folder):
    """And a precheck on other scenes tells nothing."""
    window, camera = BackgroundWindow("tile", 96.0, 96.0, 0.0), Camera(0.1, 0.2, 0.125, 96)
    scene = Scene("test-0", window, camera, Sun(0.3, 0.8), (), 0)
    Layout(run_folder).scenes("test").parent.mkdir(exist_ok=True)
    write_scenes(Layout(run_folder).scenes("test"), [scene])
    for digest, said in (("elsewhere", "rejected"), (scenes_digest([scene]), "not valid for this")):
        recheck(run_folder, {}, tiles=20, scenes=(1, digest), likeness=[likeness(0.3)])
        _, verdict = asked(run_folder, STRICT)
        assert verdict["detectors"][0]["answer"].startswith(said)
    compare(run_folder, likeness())
    _, verdict = asked(run_folder, STRICT)
    assert verdict["detectors"][0]["answer"] == "rejected"


def suite(folder, *scored):
    config = json.loads((folder / "config.json").read_text())
    named = {"version": 3, "sha256": "a" * 64, "scored": scored}
    write_json(folder / "config.json", config | {"suite": named})


def test_the_suite_is_named_only_where_all_of_it_was_scored(run_folder):
    change_tiles(run_folder, keep)
    suite(run_folder, "T-U", "R-U-0", "R-U-1")
    page, verdict = asked(run_folder, STRICT)
    assert verdict["suite"] == {"version": 3, "sha256": "a" * 64}
    assert [each["answer"] for each in verdict["detectors"]] == ["accepted", "accepted"]
    assert "Suite of attacks: version 3." in page
    suite(run_folder, "T-U", "R-U-0", "R-U-1", "T-Ma", "S-O@0.2")
    page, verdict = asked(run_folder, STRICT)
    assert verdict["suite"] == "incomplete"
    assert [each["answer"] for each in verdict["detectors"]] == ["undecided", "undecided"]
    assert (
        "but 2 of the 5 camouflages of the suite were not scored (T-Ma, S-O@0.2), so other attacks"
    ) in page
    assert "Suite of attacks: incomplete." in page
    assert "suite.version" not in page
    suite(run_folder)
    page, verdict = asked(run_folder, STRICT)
    assert (verdict["suite"], verdict["detectors"][0]["answer"]) == ("incomplete", "undecided")


def test_baselines_stand_by_both_rules_on_the_first_page_and_in_the_verdict(run_folder):
    place = run_folder / "scores" / "main" / "baselines.json"
    rows = json.loads(place.read_text())["rows"]
    lenient = {"ap_centre_in_box": 0.9, "recall_centre_in_box": 0.88, "called_another_class": 0.04}
    write_json(place, {"rows": [row | lenient if row["real"] else row for row in rows]})
    page, verdict = asked(run_folder, STRICT)
    first = page[: page.index("What to do next")].replace("\u202f", " ")
    assert (
        "On KIT AIS Munich: AP 21 % and recall 21 % by centres within 1 m, by the lenient rule "
        "AP 90 % and recall 88 %, called another class 4 %."
    ) in first
    by_dataset = {row["dataset"]: row for row in verdict["detectors"][0]["baselines"]}
    assert by_dataset["KIT AIS Munich"] == {
        **{"dataset": "KIT AIS Munich", "real": True, "vehicles": 140},
        **{"ap_centre_1m": 0.21, "recall": 0.21, **lenient},
    }
    assert by_dataset["rendered test"]["ap_centre_in_box"] is None
    full = page[page.index("On annotated images without camouflage") :]
    assert "21.0 % 16.0 % 90.0 %" in full
    assert "88.0 % 0.500 real frames" in full


def test_camouflages_that_were_not_scored_have_no_digest(run_folder):
    write_json(run_folder / "camouflages" / "T-Ma" / "camouflage.json", {})
    _, verdict = asked(run_folder, STRICT)
    assert set(verdict["sha256"]["camouflages"]) == {"T-U"}


def test_where_gradients_mislead_nothing_is_accepted(tmp_path):
    found = {"R-U-0": set(), "T-U": set(), "T-U_transfer": set()}
    # What answers find is as good an attack as any, and misleading gradients leave others open.
    kept = {"T-U_step10-0": set(), "T-U_asked1500": set(), "T-U_relaxed": set()}
    hides = missed({**found, **kept, "T-U_asked": set(range(4)), "T-U_on_mine": {0}})
    results = scored(tmp_path, hides)
    attacks = attack_tiles(results.counts, results.detectors[0], [])
    assert set(attacks) == {"T-U", "T-U_transfer", "T-U_asked", "T-U_on_mine"}
    requirement = Requirement(0.5, 0.9999)
    ruling = Ruling("mine", "accepted", ["mine is ACCEPTED: so.", "T-U hides 0 %."], 0, {})
    doubted = _doubted(ruling, requirement, ["it doubts", "nobody knows"])
    assert (doubted.answer, doubted.more_vehicles) == ("undecided", None)
    assert "less than 100\u202f%, but it doubts and nobody knows, so" in doubted.sentences[0]
    assert doubted.sentences[1:] == ["T-U hides 0 %."]
    rejected = Ruling("mine", "rejected", ["mine is REJECTED: so."], 0, {})
    assert _doubted(rejected, requirement, ["it doubts"]) is rejected


def test_the_verdict_holds_the_alarms(run_folder, monkeypatch):
    change_tiles(run_folder, keep)
    alarm = "T-U hides 0 % where it follows the detector’s gradients, and 80 % by its answers."
    found = QueryPart([], Markup(""), only=False, alarms=[alarm], conclusion="Masking alarm.")
    monkeypatch.setattr("skyproof.report.report.query_part", lambda _: found)
    page, verdict = asked(run_folder, STRICT)
    assert [each["answer"] for each in verdict["detectors"]] == ["undecided", "undecided"]
    assert verdict["alarms"] == [alarm]
    assert "ACCEPTED" not in page
    assert "RetinaNet is UNDECIDED: every attack hides significantly less than 40 %, but" in page


def test_what_was_asked_once_is_asked_again(run_folder):
    _, first = asked(run_folder, STRICT)
    _, again = asked(run_folder)
    assert again == first
    _, other = asked(run_folder, LENIENT)
    assert other["requirement"] != first["requirement"]


def test_nobody_asked(run_folder):
    page = words_of(write_report(run_folder).read_text())
    assert "verdict rests on" not in page
    assert not (run_folder / "verdict.json").exists()


def test_the_verdict_names_what_it_holds_for(run_folder):
    _, first = asked(run_folder, STRICT)
    for name in ("scenes", "backgrounds", "fleet"):
        assert first["sha256"][name] == ""  # The fabricated run has none.
    assert len(first["sha256"]["settings"]) == 64
    card = run_folder / "camouflages" / "T-U" / "camouflage.json"
    digest = first["sha256"]["camouflages"]["T-U"]
    card.write_text(card.read_text() + "\n")
    assert asked(run_folder)[1]["sha256"]["camouflages"]["T-U"] != digest


def test_without_an_attack_there_is_nothing_to_decide(run_folder):
    place = run_folder / "scores" / "main" / "outcomes.parquet"
    tiles = read_counts(place)
    controls = {key: counts for key, counts in tiles.series.items() if key.camouflage != "T-U"}
    write_counts(place, OutcomeCounts(tiles.cells, controls))
    with pytest.raises(ConfigurationError, match="found none for retinanet; attack"):
        write_report(run_folder, STRICT)
    assert not (run_folder / "verdict.json").exists()
