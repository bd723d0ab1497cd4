"""A whole run from nothing to a report, what a second call does, and the demo."""

import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from skyproof import console
from skyproof.cycles.settings import Rendering
from skyproof.detectors.card import PARENT_FILE, REFERENCE_FOLDER
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.main import run
from skyproof.render.renderer import TorchRenderer
from skyproof.results.precheck import read_precheck
from skyproof.scenes.backgrounds import BackgroundSet
from tests.cli.conftest import CHOSEN, TINY, Skyproof, bytes_of
from tests.tiny_suite import TINY_SUITE, tiny_suite

KEYS = {
    "camouflage", "renderer", "detector", "vehicles", "easr", "easr_low", "easr_high", "net_easr",
    "net_easr_low", "net_easr_high", "asr", "er", "ap_original", "ap_adversarial", "apd", "match",
}  # fmt: skip

SHORT_SUITE = replace(
    TINY_SUITE, steps=replace(TINY_SUITE.steps, texture=2), draws=1, attacks=("T-U",)
)


def test_run_folder_holds_results_and_report(finished: Path) -> None:
    rows = json.loads((finished / "results.json").read_text())["rows"]
    assert {row["match"] for row in rows} == {"centre_1m", "iou_50", "centre_in_box"}
    learnt = {"T-U", "R-U", "T-PixFcMa", "R-PixFcMa"}
    assert {row["camouflage"] for row in rows} == {*learnt, *CHOSEN}
    for row in rows:
        assert row.keys() >= KEYS
        assert (row["renderer"], row["detector"]) == ("torch", "retinanet")
        assert row["vehicles"] > 0
    page = (finished / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    environment = json.loads((finished / "environment.json").read_text())
    assert environment["device"] == "cpu"
    assert environment["finished"]
    times = json.loads((finished / "timings.json").read_text())
    assert {row["stage"] for row in times} >= {"render", "score"}


def test_second_call_changes_nothing(finished: Path, skyproof: Skyproof) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    contents = bytes_of(finished)
    for extra in ([], ["--device", "auto"]):
        answer = skyproof(*TINY, "--out", finished, *extra)
        assert answer.code == 0
        # Four steps need not hide anything.
        assert re.search("T-U (hides|is found) ", answer.out)
        assert str(finished / "report.html") in answer.out.replace("\n", "")
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before
    skyproof(*TINY, "--out", finished, "--gsd", 0.2).refused("--gsd", "--imagery")
    assert bytes_of(finished) == contents


def test_other_settings_are_refused_and_named(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    contents = bytes_of(finished)
    photo = tmp_path / "photo.tif"
    photo.touch()
    for flags, names in ((["--seed", 1], "seed"), (["--imagery", photo], "imagery")):
        skyproof(*TINY, "--out", finished, *flags).refused(
            str(finished), f"({names})", "another --out"
        )
    call = ("assess", "faster_rcnn", "--device", "cpu", "--out", finished)
    skyproof(*call).refused("(detectors, names, sources_sha256)", "another --out")
    assert bytes_of(finished) == contents


def test_a_detector_that_finds_nothing_is_refused_and_the_rest_is_done_once_it_does(
    copied, skyproof: Skyproof
) -> None:
    """With a threshold above every score there is no success rate.

    No vehicle is found before the camouflage then.
    """
    folder = copied("scores", "report.html", "results.json")
    card = folder / "detectors" / "retinanet" / "detector.json"
    good = card.read_text()
    card.write_text(json.dumps({**json.loads(good), "threshold": 1.0}))
    skyproof(*TINY, "--out", folder).refused("retinanet finds none of the", "threshold of 1")
    assert not (folder / "scores" / "test-0").exists()
    card.write_text(good)
    # What is left is done, and announced without a terminal.
    answer = skyproof(*TINY, "--out", folder)
    assert answer.code == 0
    assert "[19/20] score test-0 (about " in answer.out
    assert "[20/20] report (about " in answer.out
    assert "  score ..." in answer.out
    assert "  score: done in" in answer.out
    assert "render test" not in answer.out  # it was finished before


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The seconds that the clock of progress shows."""
    seconds = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: seconds[0])
    return seconds


def test_time_left_is_printed(now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with console.progress_bar("train x") as update:
        for step in range(101, 201):  # resumed at 100: those steps cost no time now
            now[0] += 1.0
            update(step, 200)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  train x ..."
    assert lines[1] == "  train x: 115/200, 15 s, about 1 min left"
    assert lines[-1] == "  train x: done in 2 min"


def test_no_time_left_is_printed_before_it_means_something(
    now: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with console.progress_bar("score") as update:
        # The first of 3,000 images waits for the networks, the others take 10 s each.
        for done, wait_s in enumerate([29.0, *[10.0] * 9], 1):
            now[0] += wait_s
            update(done, 3000)
    assert capsys.readouterr().out.splitlines()[1:] == [
        "  score: 1/3000, 29 s",
        "  score: 3/3000, 1 min",
        "  score: 5/3000, 1 min",
        "  score: 7/3000, 1 min, about 8.3 h left",
        "  score: 9/3000, 2 min, about 8.3 h left",
        "  score: done in 2 min",
    ]


class Stand(TorchRenderer):
    """In place of Cycles, the differentiable renderer, whose images say that Cycles drew them."""

    name = "cycles"


@pytest.fixture
def blender(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replaces Blender; returns the names of what is drawn with Cycles, in order."""
    drawn: list[str] = []

    @contextmanager
    def opened(
        rendering: Rendering, backgrounds: BackgroundSet, out: Path
    ) -> Iterator[TorchRenderer]:
        if rendering.renderer == "torch":
            yield TorchRenderer(backgrounds)
            return
        assert rendering.blender == Path("/opt/blender")
        drawn.append(out.name)
        yield Stand(backgrounds)

    monkeypatch.setattr("skyproof.cycles.renderer.open_renderer", opened)
    monkeypatch.setattr("skyproof.assessment.assess.find_blender", lambda path: path)
    return drawn


BESIDE_RANDOM = {
    "net_easr", "net_easr_low", "net_easr_high", "random_easr", "random_draw_se", "control_p",
    "control_p_holm",
}  # fmt: skip
"""What a row says of a camouflage beside random draws, but for their number."""


def without_strongest(row: dict[str, object]) -> dict[str, object]:
    """Draws and paints, which enter the strongest control, are drawn by one renderer."""
    return {name: each for name, each in row.items() if "strongest" not in name}


WITH_CYCLES = [*TINY, "--cycles", "--blender", "/opt/blender"]


def test_cycles_is_added_to_a_finished_run_and_goes_on_where_it_was_stopped(
    copied: Callable[..., Path],
    skyproof: Skyproof,
    blender: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = copied()

    def stop(*given: object) -> None:
        raise KeyboardInterrupt

    before = bytes_of(folder)
    page = (folder / "report.html").read_text()
    with monkeypatch.context() as patch:
        patch.setattr("skyproof.report.report.write_report", stop)
        assert skyproof(*WITH_CYCLES, "--out", folder).code == 130
    # The older page does not count as finished, and no scene is drawn again.
    answer = skyproof(*WITH_CYCLES, "--out", folder)
    assert answer.code == 0, answer.err
    assert blender == ["test-cycles", "test-cycles"]
    assert "on Blender Cycles images" in answer.out
    after = bytes_of(folder)
    changed = {name for name in before if after[name] != before[name]}
    records = {"environment.json", "steps.json", "timings.json"}
    assert changed == {"results.json", "report.html", *records}
    added = {"/".join(name.split("/")[:2]) for name in after.keys() - before.keys()}
    assert added == {"datasets/test-cycles", "scores/test-cycles"}
    rows = json.loads((folder / "results.json").read_text())["rows"]
    # The stand-in draws the same pictures, so all must come out the same but the name, and what is
    # said beside random patterns, which are not drawn there.
    before_rows = json.loads(before["results.json"])["rows"]
    count = len(before_rows)
    wanted = [row for row in before_rows if row["camouflage"] not in ("R-U", "R-PixFcMa")]
    beside_none = dict.fromkeys(BESIDE_RANDOM) | {"renderer": "cycles", "random_draws": 0}
    same = [without_strongest({**row, **beside_none}) for row in wanted]
    assert same == list(map(without_strongest, rows[count:]))
    assert rows[:count] == before_rows
    assert "unknown to the attack" in (folder / "report.html").read_text()
    assert "Cycles" not in page
    assert json.loads((folder / "environment.json").read_text())["finished"]
    times = json.loads((folder / "timings.json").read_text())
    assert {(row["stage"], row["name"]) for row in times} >= {
        ("render", "test-cycles"),
        ("score", "test-cycles"),
    }

    # Given again, with Cycles or without: nothing is left to do.
    for flags in (WITH_CYCLES, TINY):
        assert "[" not in skyproof(*flags, "--out", folder).out
    assert bytes_of(folder) == after
    # A page that is older than the scores is written again.
    (folder / "report.html").write_text("old")
    os.utime(folder / "report.html", (0, 0))
    assert skyproof(*WITH_CYCLES, "--out", folder).code == 0
    assert "Cycles" in (folder / "report.html").read_text()


def test_a_missing_blender_is_said_before_anything_is_done(
    tmp_path: Path, finished: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(path: Path | None) -> None:
        raise ConfigurationError(f"no Blender at {path}; run `make blender`.")

    monkeypatch.setattr("skyproof.assessment.assess.find_blender", missing)
    contents = bytes_of(finished)
    for folder in (tmp_path / "run", finished):
        skyproof(*WITH_CYCLES, "--out", folder).refused("make blender", "/opt/blender")
    assert not (tmp_path / "run").exists()
    assert bytes_of(finished) == contents
    skyproof(*TINY, "--out", finished, "--blender", "/opt/blender").refused("--cycles")


def test_any_seed_and_two_at_once(tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "run"
    call = (*TINY, "--out", out, "--seed", -1)
    with alone(out):
        skyproof(*call).refused("is being written by another process", str(os.getpid()))
    assert not out.exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skyproof.assessment.assess.attacks", lambda its: iter(()))
        answer = skyproof(*call)
    assert answer.code == 0, answer.err
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert {row["camouflage"] for row in rows} == {"R-U", "R-PixFcMa"}


@pytest.fixture(scope="module")
def demo(suites: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished demo by a suite that is far too small; not to be changed."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    with tiny_suite(SHORT_SUITE):
        assert run(["demo", "--out", str(folder), "--device", "cpu"]) == 0
    return folder


def test_the_demo_attacks_a_detector_before_and_after_hardening_and_trains_nothing(
    demo: Path,
) -> None:
    for out, name in ((demo, "retinanet"), (demo / "hardened", "retinanet_hardened")):
        rows = json.loads((out / "results.json").read_text())["rows"]
        assert {row["detector"] for row in rows} == {"retinanet"}
        assert {row["camouflage"] for row in rows} == {"T-U", "R-U", *CHOSEN[:4]}
        clean = [row["ap_original"] for row in rows if row["match"] == "centre_1m"]
        assert min(clean) > 0.5
        own, shipped = (
            bytes_of(place) for place in (out / "detectors/retinanet", REFERENCE_FOLDER / name)
        )
        # The record of the parent is that of this demo.
        assert (PARENT_FILE in own) == (out != demo)
        assert own.pop(PARENT_FILE, None) != shipped.pop(PARENT_FILE, b"")
        assert own == shipped
        assert {path.name for path in (out / "datasets").iterdir()} == {"test", "empty"}
        times = json.loads((out / "timings.json").read_text())
        assert not {"train", "check"} & {row["stage"] for row in times}
    # Each is attacked by itself, on the same scenes.
    textures = [bytes_of(out / "camouflages/T-U") for out in (demo, demo / "hardened")]
    assert textures[0] != textures[1]
    scenes = [(out / "scenes/test.jsonl").read_bytes() for out in (demo, demo / "hardened")]
    assert scenes[0] == scenes[1]


def test_the_first_figure_shows_the_attack_before_and_after_hardening(demo: Path) -> None:
    page = (demo / "hardened/report.html").read_text()
    assert "Its parent was assessed on other scenes" not in page
    figure = page[page.index('<figure class="show">') : page.index("</figure>")]
    pictures = re.findall('src="([^"]+)" alt="[^"]*( without|, before|, after) ', figure)
    assert [where for _, where in pictures] == [" without", ", before", ", after"]
    assert "<h1>After hardening: How robust" in page
    assert re.search("Before hardening, T-U hid [−0-9]+", page)
    # What was done already is not advised again.
    assert "Harden the detectors as described below" not in page
    assert "skyproof harden" not in page
    # The best pattern is compared, too, but is no attack.
    assert "<td>best pattern, R-U_pattern</td>" in page
    assert re.search(r"the strongest attack hides [−0-9]+\s% \(T-U\), from its parent", page)
    first = (demo / "report.html").read_text()
    assert "<h1>After hardening" not in first
    figure = first[first.index('<figure class="show">') : first.index("</figure>")]
    assert len(re.findall("<img ", figure)) == 2
    told = json.loads((demo / "hardened/detectors/retinanet/parent.json").read_text())
    (row,) = (
        row
        for row in json.loads((demo / "results.json").read_text())["rows"]
        if (row["camouflage"], row["match"]) == ("T-U", "centre_1m")
    )
    assert told["rates"]["T-U"]["frozen"]["hidden"][0] == pytest.approx(row["easr"])


def test_two_detectors_are_attacked_together_and_told_apart(
    tmp_path: Path, suites: None, skyproof: Skyproof
) -> None:
    out = tmp_path / "run"
    with tiny_suite(SHORT_SUITE):
        answer = skyproof("assess", "retinanet", "faster_rcnn", "--device", "cpu", "--out", out)
    assert answer.code == 0, answer.err
    rows = json.loads((out / "results.json").read_text())["rows"]
    of_one = {
        row["detector"]: row["easr"]
        for row in rows
        if (row["camouflage"], row["match"]) == ("T-U", "centre_1m")
    }
    assert of_one.keys() == {"retinanet", "faster_rcnn", "mean"}
    assert of_one["mean"] == pytest.approx((of_one["retinanet"] + of_one["faster_rcnn"]) / 2)
    record = json.loads((out / "camouflages/T-U/camouflage.json").read_text())
    assert record["record"]["attack"]["detectors"].keys() == {"retinanet", "faster_rcnn"}
    assert "are the detectors worth attacking?" in (out / "report.html").read_text()


def test_a_finished_demo_is_not_done_again(demo: Path, suites: None) -> None:
    before = {path: path.stat().st_mtime_ns for path in demo.rglob("*")}
    with tiny_suite(SHORT_SUITE):
        assert run(["demo", "--out", str(demo), "--device", "cpu"]) == 0
    assert {path: path.stat().st_mtime_ns for path in demo.rglob("*")} == before


def test_the_report_says_that_it_was_checked_before(demo: Path) -> None:
    page = (demo / "report.html").read_text()
    scenes = read_precheck(REFERENCE_FOLDER / "retinanet").measured_on.scenes
    told = (
        f"The precheck of RetinaNet was made earlier, on {scenes} scenes of "
        "procedural ground, not on the scenes of this run."
    )
    assert page.count(told) == 1
    assert "is the detector worth attacking?" in page
    assert ": no precheck" not in page
