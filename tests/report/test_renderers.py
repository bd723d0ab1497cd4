"""The report where the same scenes were judged under two renderers, and the comparison between them."""

import base64
import io
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
from fabricate import fabricate, fabricate_cycles

from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_json
from skyproof.report.renderers import compare_renderers, survival
from skyproof.report.report import write_report
from skyproof.report.run import Headline
from skyproof.words import interval, percent, points

RATES = ("easr", "net_easr")


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = fabricate(tmp_path_factory.mktemp("run"), scenes=16)
    write_report(folder)
    (folder / "report.html").rename(folder / "without.html")
    write_report(fabricate_cycles(folder))
    return folder


@pytest.fixture
def run_folder(both, tmp_path):
    return Path(shutil.copytree(both, tmp_path / "run"))


@pytest.fixture
def page(both):
    return (both / "report.html").read_text()


def words_of(text):
    return re.sub(
        r"\s+", " ", re.sub(r"<(svg|style).*?</\1>|<[^>]+>", " ", text, flags=re.S)
    ).strip()


def table_of(page, caption):
    """The body of the table with these words in its caption, as rows of cells."""
    table = next(
        part
        for part in re.findall(r"<table>.*?</table>", page, re.S)
        if caption in part.split("</caption>")[0]
    )
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table[table.index("<tbody>") :], re.S)
    return [
        [words_of(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)] for row in rows
    ]


def rows_of(path, camouflage, match="centre_1m"):
    rows = read_json(path)["rows"]
    return {
        row["detector"]: row
        for row in rows
        if (row["camouflage"], row["match"]) == (camouflage, match)
    }


def shown(row, key):
    return words_of(f"{percent(row[key])} ({interval(row[key + '_low'], row[key + '_high'])})")


def test_every_number_stands_in_the_cell_of_its_renderer(both, page):
    cells = {row[0]: row[1:] for row in table_of(page, "T-U on both renderers")}
    files = (both / "results.json", both / "evaluation-cycles" / "results.json")
    attack, control = ([rows_of(path, name) for path in files] for name in ("T-U", "R-U"))
    assert list(cells) == ["RetinaNet", "Faster R-CNN", "mean"]
    for label, name in (
        ("RetinaNet", "retinanet"),
        ("Faster R-CNN", "faster_rcnn"),
        ("mean", "mean"),
    ):
        expected = [shown(rows[name], "easr") for rows in attack]
        expected += [shown(rows[name], "easr") for rows in control]
        expected += [shown(rows[name], "net_easr") for rows in attack]
        assert cells[label][:6] == expected
        change = attack[1][name]["net_easr"] - attack[0][name]["net_easr"]
        assert cells[label][6].split()[0] == points(change)
        assert cells[label][7:] == [words_of(percent(ap, 1)) for ap in (0.97, 0.88)]
    assert cells["mean"][0] != cells["mean"][1]


def test_both_renderers_have_an_answer_and_their_tables(page):
    text = words_of(page)
    first, second = (
        text.index("images of the differentiable renderer, which"),
        text.index("images of Blender Cycles, which"),
    )
    assert first < second < text.index("Results in full")
    for heading in ("Differentiable renderer, found = centre", "Blender Cycles, found = boxes"):
        assert len(table_of(page, heading)) == 6  # T-U and R-U for two detectors and their mean
    assert "Net success is lower in this light" in text
    assert "same synthetic vehicle shapes" in text[text.index("Limits") :]


def test_detectors_are_checked_on_the_images_of_both(run_folder, page):
    checked = {(row[0], row[1]): row[4] for row in table_of(page, "On clean, annotated images")}
    assert {
        key: words_of(percent(ap, 1))
        for key, ap in (("rendered test", 0.97), ("Blender Cycles test", 0.88))
    } == {
        name: ap
        for (detector, name), ap in checked.items()
        if detector == "RetinaNet" and "test" in name
    }
    # Images by Blender are not real ones.
    clean = run_folder / "evaluation" / "clean.json"
    write_json(clean, [row for row in read_json(clean) if row["dataset"] == "rendered test"])
    assert "No real annotated images were tested" not in page
    assert "No real annotated images were tested" in write_report(run_folder).read_text()


def test_pairs_come_from_the_images_of_their_renderer(page):
    def is_blue(picture):
        colour = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))))[5, 5]
        return bool(np.abs(colour.astype(int) - (30, 60, 200)).max() < 12)

    pictures = re.findall(
        r'<img src="data:image/jpeg;base64,([^"]+)" alt="Scene (\S+) [^"]*?camouflage(.*?)"', page
    )
    drawn = [(scene, "Cycles" in rest, is_blue(picture)) for picture, scene, rest in pictures]
    assert (
        [blue for _, _, blue in drawn]
        == [said for _, said, _ in drawn]
        == [False] * 16 + [True] * 10
    )
    assert [scene for scene, _, _ in drawn[:6]] == [scene for scene, _, _ in drawn[16:22]]


def test_without_cycles_the_page_is_as_before(both, run_folder):
    shutil.rmtree(run_folder / "evaluation-cycles")
    page = write_report(run_folder).read_text()
    assert page == (both / "without.html").read_text()
    assert "Cycles" not in page
    assert "Renderer torch, found = centre within 1.0 m" in page


@pytest.mark.parametrize("missing", ["outcomes.parquet", "clean.json", "detections"])
def test_missing_parts_of_cycles_are_left_out(run_folder, missing):
    path = run_folder / "evaluation-cycles" / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    page = write_report(run_folder).read_text()
    assert ("No matched pairs are shown" in page) == (missing != "clean.json")
    assert len(table_of(page, "T-U on both renderers")) == 3


def test_an_evaluation_of_another_renderer_is_refused(run_folder):
    shutil.copy(run_folder / "results.json", run_folder / "evaluation-cycles" / "results.json")
    with pytest.raises(StoredFileError, match="evaluation-cycles should hold"):
        write_report(run_folder)
    (run_folder / "evaluation-cycles" / "results.json").unlink()
    with pytest.raises(StoredFileError, match=r"evaluation-cycles/results\.json"):
        write_report(run_folder)


def headline(renderer, easr, net=None, interval_m=0.05):
    """One detector's rates with intervals of this half-width, None for none."""
    row = {"detector": "retinanet", "easr": easr, "net_easr": net}
    for key in RATES:
        known = row[key] is not None and interval_m is not None
        row |= (
            {f"{key}_low": row[key] - interval_m, f"{key}_high": row[key] + interval_m}
            if known
            else {}
        )
        row |= {} if known else {f"{key}_low": None, f"{key}_high": None}
    return Headline("T-U", renderer, row, [row], {})


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (
            headline("torch", 0.9, 0.85),
            headline("cycles", 0.6, 0.5),
            "The missing part leant on how the differentiable",
        ),
        (
            headline("torch", 0.9, 0.85),
            headline("cycles", 0.88, 0.6),
            "Random patterns hide more here",
        ),
        (headline("torch", 0.6, 0.5), headline("cycles", 0.9, 0.85), "Net success is higher"),
        (headline("torch", 0.9, 0.85), headline("cycles", 0.86, 0.79), "cannot be told apart"),
        (headline("torch", 0.9), headline("cycles", 0.6, 0.5), "The share hidden is lower"),
        (
            headline("torch", 0.9, 0.85, None),
            headline("cycles", 0.6, 0.5),
            "The difference has no interval",
        ),
        (headline("torch", 0.9, 0.85), headline("cycles", None), "cannot be compared"),
    ],
)
def test_survival_in_words(first, second, said):
    assert said in survival(first, second)


def test_limits_of_the_change_by_hand():
    """0.4 − 0.9: 0.03 and 0.04 below, a triangle of 3, 4, 5; 0.12 and 0.05 above, one of 5, 12, 13."""
    first = {"detector": "mean", "net_easr": 0.9, "net_easr_low": 0.85, "net_easr_high": 0.94}
    second = {"detector": "mean", "net_easr": 0.4, "net_easr_low": 0.37, "net_easr_high": 0.52}
    only_first = {**first, "detector": "yolov5"}
    rows = compare_renderers(
        Headline("T-U", "torch", {}, [only_first, first], {}),
        Headline("T-U", "cycles", {}, [second], {}),
    )
    assert [row.detector for row in rows] == ["mean"]
    change = rows[0].change
    assert (change.estimate, change.low, change.high) == pytest.approx((-0.5, -0.55, -0.37))


def test_points():
    assert (points(-0.217), points(0.04), points(-0.001), points(None)) == ("−22", "+4", "0", "–")
