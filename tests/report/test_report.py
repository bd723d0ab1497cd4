"""The report of a fabricated run folder is tested.

Its numbers, its honesty, and what it does without optional parts are looked at.
"""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from skyproof.errors import RunFolderError, StoredFileError
from skyproof.files import alone, write_json
from skyproof.report.answer import answer
from skyproof.report.baseline import PrecheckPart
from skyproof.report.figures import condition_figure
from skyproof.report.opening import opening
from skyproof.report.report import write_report
from skyproof.results.conditions import Bin, Panel
from skyproof.results.statistics.intervals import Interval
from skyproof.words import hides, interval, number, percent, probability
from tests.report.fabricate import fabricate
from tests.results.rows import beside, made_row


@pytest.fixture(scope="module")
def fabricated(tmp_path_factory):
    folder = fabricate(tmp_path_factory.mktemp("run"), scenes=16)
    write_report(folder)
    return folder


@pytest.fixture
def run_folder(fabricated, tmp_path):
    return Path(shutil.copytree(fabricated, tmp_path / "run"))


@pytest.fixture
def page(fabricated):
    return (fabricated / "report.html").read_text()


def rebuilt(folder):
    return write_report(folder).read_text()


def words_of(page):
    """What a reader sees, white space and tags folded."""
    return re.sub(r"\s+", " ", re.sub(r"<(svg|style).*?</\1>|<[^>]+>", " ", page, flags=re.S))


def test_the_numbers_are_those_of_the_results(fabricated, page):
    text = words_of(page)
    for row in json.loads((fabricated / "results.json").read_text())["rows"]:
        for key in ("easr", "net_easr", "random_easr"):
            if row[key] is not None and row["detector"] == "mean":
                assert percent(row[key]).replace("\u202f", " ") in text
        assert percent(row["asr"], 1).replace("\u202f", " ") in text
    mean = next(
        r
        for r in json.loads((fabricated / "results.json").read_text())["rows"]
        if r["detector"] == "mean"
    )
    limits = interval(mean["easr_low"], mean["easr_high"]).replace("\u202f", " ")
    assert f"hides {percent(mean['easr'])} (95 % interval {limits})".replace("\u202f", " ") in text


def first_lines(page):
    """The page up to the sentence on what was tested."""
    text = words_of(page[page.index("<body>") :]).replace("\u202f", " ")
    return text[: text.index("overhead vehicle detector")]


def change_checks(folder, change):
    path = folder / "scores" / "main" / "baselines.json"
    rows = [changed for row in json.loads(path.read_text())["rows"] if (changed := change(row))]
    write_json(path, {"rows": rows})


def test_synthetic_data_alone_is_said_in_the_first_lines(run_folder):
    change_checks(run_folder, lambda row: None if row["real"] else row)
    page = rebuilt(run_folder)
    told = first_lines(page)
    assert "Synthetic data only. Ground, vehicles and all images of the baseline are" in told
    assert "They are no evidence about real imagery" in told
    change_checks(run_folder, lambda row: None)
    page = rebuilt(run_folder)
    assert "Synthetic data only." in first_lines(page)
    assert "The baseline of these detectors is not known" in page[: page.index("What each attack")]


def test_rendered_frames_do_not_count_as_real(run_folder):
    change_checks(run_folder, lambda row: row | {"real": False})
    assert "Synthetic data only." in first_lines(rebuilt(run_folder))


def test_synthetic_ground_with_a_check_on_real_images(page, run_folder):
    told = first_lines(page)
    assert "Synthetic ground and vehicles, baseline on photographs." in told
    assert (
        "an AP of 21 % (RetinaNet, 19 to 23 %) and 21 % (Faster R-CNN, 19 to 23 %) on KIT AIS "
        "Munich. RetinaNet and Faster R-CNN are below 80 %: attacks on detectors"
    ) in told
    change_checks(
        run_folder,
        lambda row: row | {"ap_centre_1m": 0.85} if row["detector"] == "retinanet" else row,
    )
    assert "KIT AIS Munich. Faster R-CNN is below 80 %" in first_lines(rebuilt(run_folder))
    change_checks(run_folder, lambda row: row | {"ap_centre_1m": 0.85})
    assert "below 80 %" not in first_lines(rebuilt(run_folder))


@pytest.mark.parametrize("checked", [True, False])
def test_real_ground(run_folder, checked):
    config = json.loads((run_folder / "config.json").read_text())
    write_json(run_folder / "config.json", config | {"imagery": ["Selwyn 2012"]})
    change_checks(run_folder, lambda row: row if checked or not row["real"] else None)
    real = rebuilt(run_folder)
    told = first_lines(real)
    assert "Real ground, rendered vehicles." in told
    assert (
        "On real vehicles without camouflage the detectors score an AP of 21 %" in told
    ) == checked
    assert ("No annotated photographs were scored" in told) != checked
    assert "Selwyn 2012" in real[: real.index("What each attack")]
    assert "were not removed by skyproof" in told
    totals = {"labelled_removed": 1200, "detected_removed": 34, "masked_share": 0.11}
    (run_folder / "backgrounds").mkdir(exist_ok=True)
    write_json(run_folder / "backgrounds/clearing.json", {"totals": totals, "tiles": []})
    told = first_lines(rebuilt(run_folder))
    assert "1,234 vehicles were removed from the photographs, which filled 11 % of the" in told
    assert "were not removed" not in told
    write_json(run_folder / "backgrounds/clearing.json", {"totals": totals | {"masked_share": 2}})
    with pytest.raises(StoredFileError, match="clear the ground again"):
        rebuilt(run_folder)


def test_what_the_detectors_score_stands_above_the_answer(run_folder, page):
    table = page[page.index('<table class="checked">') : page.index("What each attack hides")]
    rows = [
        words_of(row).replace("\u202f", " ").strip()
        for row in re.findall(r"<tr><td.*?</tr>", table, re.S)
    ]
    assert rows == [
        "rendered test (rendered) 60 images, 140 vehicles; intervals over 20 background "
        "tiles " + " ".join(["97.0 % (95 to 99 %) recall 97 %, precision 90 %"] * 2),
        "KIT AIS Munich (photographs) 60 images, 140 vehicles; real frames, resampled to 0.125 m; "
        "one place: intervals over its 60 images, which are too narrow "
        + " ".join(["21.0 % (19 to 23 %) recall 21 %, precision 90 %"] * 2),
    ]
    # A detector may be missing from a set, an interval from a row, and places may be told apart.
    change_checks(
        run_folder,
        lambda row: (
            row
            | {"ap_centre_1m_low": None, "ap_centre_1m_high": None}
            | ({"clustered_by": "places", "clusters": 2} if row["real"] else {})
            if (row["detector"], row["real"]) != ("faster_rcnn", True)
            else None
        ),
    )
    page = rebuilt(run_folder)
    table = words_of(
        page[page.index('<table class="checked">') : page.index("What each attack hides")]
    ).replace("\u202f", " ")
    assert "intervals over 2 places 21.0 % recall 21 %, precision 90 % –" in table
    assert "an AP of 21 % (RetinaNet) on KIT AIS Munich" in first_lines(page)


class _Loads(HTMLParser):
    """Collects what a browser would fetch."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attributes):
        loads = ("src", "href", "xlink:href", "srcset")
        self.found += [value for name, value in attributes if name in loads]
        self.found += ["script"] if tag == "script" else []


def test_the_page_loads_nothing_from_outside(page):
    parser = _Loads()
    parser.feed(page)
    assert parser.found
    assert all(value.startswith(("data:", "#")) for value in parser.found)
    assert "url(http" not in page
    assert "@import" not in page


def test_pairs_are_drawn_and_their_choice_is_stated(page):
    assert len(re.findall(r'alt="Scene \S+ with T-U"', page)) == 8
    assert page.count('with the strongest attack"') == 1
    assert page.count("Chosen by hash") == 6
    assert "Fewest vehicles hidden" in page


def test_the_same_folder_gives_the_same_page(run_folder, page):
    assert rebuilt(run_folder) == page


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("environment.json", "does not say which versions"),
        ("scores/main/pairs", "no score folder holds pictures of T-U"),
        ("scores/main/patterns", "There is no picture of the texture map"),
        ("scores/main/patterns/T-U/on_vehicle.png", "no picture of the pattern on a vehicle"),
        ("detectors", "What each attack hides"),
        ("camouflages", "What each attack hides"),
        ("timings.json", "What each attack hides"),
    ],
)
def test_missing_optional_parts_are_said(run_folder, missing, said):
    path = run_folder / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert said in rebuilt(run_folder)


def test_missing_checks_are_said(run_folder):
    change_checks(run_folder, lambda row: None)
    page = rebuilt(run_folder)
    assert "No annotated photographs were tested" in page
    assert "No images without camouflage were scored." in page


def result(easr, net=None, random=None, name="T-U", **given):
    beside_random = None if net is None else beside("R-U", random, net)
    return made_row(name, "retinanet", easr=easr, random=beside_random, **given)


def test_an_answer_without_control_or_without_a_rate():
    nan = float("nan")
    (_, without, unchosen, _) = answer([result(Interval(0.5, 0.4, 0.6))])
    assert "No random control was scored" in without
    assert "the effect of the optimisation is unknown" in unchosen
    (only,) = answer([result(Interval(nan, nan, nan))])
    assert "The success rate is undefined" in only


def test_an_answer_tells_the_hidden_from_those_seen_beside_their_place():
    one = result(Interval(0.82, 0.74, 0.89))
    lenient = dataclasses.replace(one, match="centre_in_box", easr=Interval(0.04, 0.01, 0.08))
    said = " ".join(answer([one], lenient))
    assert "it hides 4\u202f% (95\u202f% interval 1 to 8\u202f%). The other 78 points are" in said
    as_many = dataclasses.replace(lenient, easr=Interval(0.8, 0.7, 0.9))
    said = " ".join(answer([one], as_many))
    assert "it hides 80\u202f% (95\u202f% interval 70 to 90\u202f%)." in said
    assert "lenient" not in " ".join(answer([one]))


def test_an_answer_says_what_its_intervals_leave_out():
    easr, net = Interval(0.5, 0.4, 0.6, errors={"tiles": 0.05}), Interval(0.3, 0.2, 0.5)
    single = " ".join(answer([result(easr, net, 0.2)]))
    assert "One vehicle was tested, so the interval does not cover other vehicles." in single
    assert "the interval allows for the largest spread of seeds measured" in single
    assert "the net interval allows for the largest spread of draws measured" in single
    several = dataclasses.replace(easr, errors={"tiles": 0.05, "vehicles": 0.0})
    row = dataclasses.replace(
        result(several, net, 0.2), repeats=3, random=beside("R-U", 0.2, net, draws=30)
    )
    assert "not cover" not in " ".join(answer([row]))


def test_what_the_intervals_are_made_of(fabricated, page):
    row = next(
        row
        for row in json.loads((fabricated / "results.json").read_text())["rows"]
        if (row["camouflage"], row["detector"], row["match"]) == ("T-U", "mean", "centre_1m")
    )
    errors = [row[name] for name in ("easr_tile_se", "easr_vehicle_se", "random_draw_se")]
    tiles, vehicles, draws = (f"{100 * error:.1f}" for error in errors)
    text = words_of(page[page.index("Components of the intervals") :])
    # One attack was run, and two draws that are nearer than draws usually are.
    assert f"net EASR: random draws T-U {tiles} {vehicles} 4.6 {draws}" in text
    assert float(draws) == 6.4
    assert "p against random draws (Holm)" in words_of(page)


def test_a_net_rate_that_could_be_zero_is_not_called_success():
    text = " ".join(answer([result(Interval(0.5, 0.4, 0.6), Interval(0.3, -0.02, 0.5), 0.2)]))
    assert "The difference from an average random pattern of the same kind (" in text
    assert "is not significant" in text
    assert "own effect" not in text


def test_an_answer_says_what_is_hidden_more_than_average_and_than_the_strongest_control():
    found = beside("R-PixMa_search", 0.3, Interval(0.2, 0.05, 0.3))
    hidden, average, best, *_ = answer(
        [result(Interval(0.5, 0.4, 0.6), Interval(0.45, 0.3, 0.5), 0.05, strongest=found)]
    )
    assert "hides 50 % (95 % interval 40 to 60 %)" in hidden
    assert average == (
        "It hides 45 points more (95 % interval 30 to 50) than an average random pattern of "
        "the same kind (5 %)."
    )
    assert best == (
        "It hides 20 points more (95 % interval 5 to 30) than the strongest control without "
        "optimisation, a random search with as many images (30 %). The difference is the "
        "optimisation’s own effect."
    )
    several = result(Interval(0.5, 0.4, 0.6), strongest=dataclasses.replace(found, draws=5))
    assert "the mean of 5 random searches, each with as many images (30" in answer([several])[1]
    as_good = beside("R-Ma_plain", 0.45, Interval(0.05, -0.02, 0.1))
    _, average, best, *_ = answer(
        [result(Interval(0.5, 0.4, 0.6), Interval(0.45, 0.3, 0.5), 0.05, strongest=as_good)]
    )
    assert "more" in average
    assert "The difference from the strongest control" in best
    assert "the best plain paint (45" in best
    assert "own effect" not in best
    worse = beside("R-U_best", 0.7, Interval(-0.2, -0.3, -0.1))
    # Where the best of many was judged, nobody misses the average of a few.
    _, best, _ = answer([result(Interval(0.5, 0.4, 0.6), strongest=worse)])
    assert "It hides less than" in best
    assert "the best of many random draws" in best


def test_an_answer_says_what_the_shape_of_a_combination_adds():
    same = beside("R-C-Fc-seq@0.2", 0.4, Interval(0.1, 0.04, 0.2))
    even = beside("R-C-U@0.2_plain", 0.1, Interval(0.4, 0.3, 0.5))
    text = answer(
        [result(Interval(0.5, 0.4, 0.6), name="C-Fc-seq@0.2", drawn_shape=same, strongest=even)]
    )
    assert "10 points more (95 % interval 4 to 20) than its own texture under" in text[1]
    assert "the best plain paint and every vertex out (10" in text[2]


def test_nothing_scored_is_said(tmp_path):
    with pytest.raises(StoredFileError, match="holds no scores; run skyproof score"):
        write_report(tmp_path)


def test_scores_alone_do_not_claim_to_know_the_ground(run_folder):
    (run_folder / "config.json").unlink()
    text = words_of(rebuilt(run_folder))
    assert "Unknown ground." in text
    assert "over ground that is not recorded" in text
    assert "Synthetic data only" not in text
    assert "The ground is real" not in text


def test_the_ground_is_read_where_it_is_recorded(run_folder):
    """A page once said that nothing was recorded beside an index.json that said it."""
    (run_folder / "config.json").unlink()
    write_json(
        run_folder / "backgrounds" / "index.json", {"tiles": [{"source": "Selwyn 2012.tif"}]}
    )
    text = words_of(rebuilt(run_folder))
    assert "Unknown ground." not in text
    assert "over real imagery (Selwyn 2012.tif)" in text
    shutil.rmtree(run_folder / "backgrounds")
    record = json.loads((run_folder / "scores" / "main" / "score.json").read_text())
    write_json(run_folder / "scores" / "main" / "score.json", record | {"sources": ["procedural"]})
    assert "over procedurally generated ground" in words_of(rebuilt(run_folder))


def test_a_single_score_folder_is_reported_too(run_folder):
    page = rebuilt(run_folder / "scores" / "main")
    assert page.count("Chosen by hash") == 6
    assert json.loads((run_folder / "scores" / "main" / "results.json").read_text())["rows"]


def test_checks_alone_are_reported(run_folder):
    score = run_folder / "scores" / "main"
    for name in ("sets.json", "outcomes.parquet"):
        (score / name).unlink()
    record = json.loads((score / "score.json").read_text())
    write_json(score / "score.json", record | {"renderer": None})
    text = words_of(rebuilt(run_folder)).replace("\u202f", " ")
    assert "No camouflage was scored." in text
    assert "21.0 % (19 to 23 %) recall 21 %, precision 90 %" in text
    assert "What each attack hides" not in text


def test_damaged_files_name_the_file(run_folder):
    pairs = run_folder / "scores" / "main" / "pairs" / "original"
    for picture in pairs.iterdir():
        picture.write_bytes(b"no image")
    with pytest.raises(StoredFileError, match=r"scene-\d+\.jpg cannot be read as a picture"):
        write_report(run_folder)
    write_json(run_folder / "scores" / "main" / "baselines.json", {"rows": [{"detector": "x"}]})
    with pytest.raises(StoredFileError, match=r"baselines\.json"):
        write_report(run_folder)


def test_it_says_what_each_detector_was_trained_on(page):
    assert "renders for retinanet" in words_of(page)


def test_text_from_files_is_escaped(run_folder):
    config = json.loads((run_folder / "config.json").read_text())
    write_json(run_folder / "config.json", config | {"title": "<script>alert(1)</script>"})
    assert "<script>" not in rebuilt(run_folder)


def test_the_report_imports_no_torch():
    code = "import sys, skyproof.report.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_bin_without_an_estimate_is_drawn_empty():
    nan = float("nan")
    panel = Panel(
        "Body type",
        [Bin("van", 0, Interval(nan, nan, nan)), Bin("car", 3, Interval(0.5, 0.2, 0.8))],
        0.5,
    )
    assert condition_figure([panel]).startswith("<svg")


def test_no_attack_hides_a_negative_share():
    row = result(Interval(-0.53, -0.6, -0.4))
    first = opening([row], None, PrecheckPart([], [], [], [], []), [], hardened=False)
    assert first.figure == "0\u202f%"
    assert first.sentence.startswith("No attack hides vehicles from RetinaNet: ")
    assert first.sentence.endswith("(T-U) is found 53\u202f% more often.")
    lenient = dataclasses.replace(row, match="centre_in_box")
    assert "it is found 53\u202f% more often (95" in " ".join(answer([row], lenient))


def test_numbers_as_words():
    assert hides(0.48) == "hides 48\u202f%"
    assert hides(-0.004) == "hides 0\u202f%"
    assert hides(-0.53) == "is found 53\u202f% more often"
    assert percent(0.845, 1) == "84.5\u202f%"
    assert percent(-0.001) == "0\u202f%"
    assert percent(-0.12) == "−12\u202f%"
    assert percent(None) == interval(None, 1.0) == number(None) == probability(None) == "–"
    assert interval(0.79, 0.88) == "79 to 88\u202f%"
    assert number(12345.6) == "12\u202f346"
    assert (probability(1e-9), probability(0.04)) == ("< 0.001", "0.040")


def test_files_of_others_are_not_replaced(run_folder):
    write_report(run_folder)
    # Ours are replaced.
    write_report(run_folder)
    (run_folder / "results.json").unlink()
    (run_folder / "report.html").write_text("my own page")
    with pytest.raises(RunFolderError, match=r"report\.html is there without a results\.json"):
        write_report(run_folder)
    assert (run_folder / "report.html").read_text() == "my own page"
    assert not (run_folder / "results.json").exists()
    (run_folder / "report.html").unlink()
    (run_folder / "results.json").write_text('{"mine": 1}')
    with pytest.raises(StoredFileError, match=r"results\.json.* not replaced"):
        write_report(run_folder)
    assert (run_folder / "results.json").read_text() == '{"mine": 1}'


def test_two_reports_at_once(run_folder):
    with alone(run_folder / "report.html"), pytest.raises(RunFolderError, match="being written"):
        write_report(run_folder)


def test_a_link_out_of_the_run_is_not_shown(run_folder, tmp_path):
    pairs = run_folder / "scores" / "main" / "pairs" / "original"
    secret = tmp_path / "secret.jpg"
    for picture in pairs.iterdir():
        picture.rename(secret)
        picture.symlink_to(secret)
    with pytest.raises(StoredFileError, match="leads out of its folder"):
        write_report(run_folder)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("config.json", '{"seed": 1e999}'),
        ("config.json", '{"imagery": {"a": 1}}'),
        ("config.json", "[" * 100_000),
        ("environment.json", '{"commands": "rm"}'),
        ("timings.json", '[{"stage": "train", "seconds": -1}]'),
        ("timings.json", '{"stage": 1}'),
        ("scores/main/score.json", '{"thresholds": {"../x": 0.5}}'),
        ("scores/main/score.json", '{"thresholds": {"a": "0.5"}}'),
        ("scores/main/sets.json", '{"rows": [{"camouflage": "/etc"}]}'),
        ("scores/main/pairs/pairs.json", '{"rows": [{"original": "../../x.jpg"}]}'),
        ("detectors/retinanet/steps.jsonl", '{"step": 1}'),
        ("detectors/retinanet/steps.jsonl", '{"step": 1, "loss": NaN}'),
        ("detectors/retinanet/detector.json", '{"threshold": "high"}'),
        ("camouflages/T-U/camouflage.json", '{"record": {"attack": 5}}'),
        ("verdict.json", "{}"),
        ("verdict.json", '{"requirement": {"accept": 0.5, "reject": 0.2}}'),
        ("verdict.json", '{"requirement": {"accept": 0.1, "reject": 20}}'),
    ],
)
def test_damage_is_one_sentence_with_the_file(run_folder, file, content):
    path = run_folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    with pytest.raises(StoredFileError) as refused:
        write_report(run_folder)
    said = str(refused.value)
    assert path.name in said
    assert "\n" not in said
    assert len(said) < 700


def test_a_report_does_not_write_through_links(run_folder, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (run_folder / "scores").rename(elsewhere)
    (run_folder / "scores").symlink_to(elsewhere)
    with pytest.raises(RunFolderError, match="scores is a link to a folder elsewhere"):
        write_report(run_folder)
