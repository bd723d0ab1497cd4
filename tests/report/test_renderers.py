"""The report on scenes that were judged under two renderers.

It also compares the two.
"""

import base64
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyproof.files import write_json
from skyproof.report.answer import survival
from skyproof.report.report import write_report
from skyproof.reproduction.cycles import cycles_columns
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.results import RendererChange, Results
from skyproof.results.statistics.intervals import Interval
from skyproof.words import interval, percent, points
from tests.report.fabricate import fabricate, fabricate_cycles
from tests.results.rows import made_row


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
        for part in re.findall(r"<table[^>]*>.*?</table>", page, re.S)
        if caption in part.split("</caption>")[0]
    )
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table[table.index("<tbody>") :], re.S)
    return [
        [words_of(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)] for row in rows
    ]


def rows_of(folder, camouflage, renderer, match="centre_1m"):
    rows = json.loads((folder / "results.json").read_text())["rows"]
    return {
        row["detector"]: row
        for row in rows
        if (row["camouflage"], row["renderer"], row["match"]) == (camouflage, renderer, match)
    }


def shown(row, key):
    return words_of(f"{percent(row[key])} ({interval(row[key + '_low'], row[key + '_high'])})")


def test_every_number_stands_in_the_cell_of_its_renderer(both, page):
    cells = {row[0]: row[1:] for row in table_of(page, "T-U on both renderers")}
    attack, control = (
        [rows_of(both, name, renderer) for renderer in ("torch", "cycles")]
        for name in ("T-U", "R-U")
    )
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
        for place, key in ((6, "easr"), (7, "net_easr")):
            change = attack[1][name][key] - attack[0][name][key]
            assert cells[label][place].split()[0] == points(change)
        assert cells[label][8:] == [words_of(percent(ap, 1)) for ap in (0.97, 0.88)]
    assert cells["mean"][0] != cells["mean"][1]


def test_both_renderers_have_an_answer_and_their_tables(page):
    text = words_of(page)
    first, second = (
        text.index("images of the differentiable renderer, used by"),
        text.index("images of Blender Cycles, unknown to"),
    )
    assert first < second < text.index("Results in full")
    for heading in ("differentiable renderer), found = centre", "Blender Cycles), found = boxes"):
        assert len(table_of(page, heading)) == 6  # T-U and R-U for two detectors and their mean
    assert "Net success is lower in this light" in text
    assert "same synthetic vehicle shapes" in text[text.index("Limits") :]


def test_detectors_are_checked_on_the_images_of_both(run_folder, page):
    checked = {
        (row[0], row[1]): row[4] for row in table_of(page, "On annotated images without camouflage")
    }
    assert {
        key: words_of(percent(ap, 1))
        for key, ap in (("rendered test", 0.97), ("Blender Cycles test", 0.88))
    } == {
        name: ap
        for (detector, name), ap in checked.items()
        if detector == "RetinaNet" and "test" in name
    }
    # Images by Blender are not real ones.
    clean = run_folder / "scores" / "main" / "baselines.json"
    rows = [
        row for row in json.loads(clean.read_text())["rows"] if row["dataset"] == "rendered test"
    ]
    write_json(clean, {"rows": rows})
    assert "No annotated photographs were tested" not in page
    assert "No annotated photographs were tested" in write_report(run_folder).read_text()


def test_pairs_come_from_the_images_of_their_renderer(page):
    def is_blue(picture):
        colour = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))))[5, 5]
        return bool(np.abs(colour.astype(int) - (30, 60, 200)).max() < 12)

    pictures = re.findall(
        r'<img src="data:image/jpeg;base64,([^"]+)" alt="Scene (\S+) (.*?)"', page
    )
    drawn = [(scene, "Cycles" in rest, is_blue(picture)) for picture, scene, rest in pictures]
    assert (
        [blue for _, _, blue in drawn]
        == [said for _, said, _ in drawn]
        == [False] * 18 + [True] * 10
    )
    # The first two are those of the first screen.
    assert [scene for scene, _, _ in drawn[2:8]] == [scene for scene, _, _ in drawn[18:24]]


def test_without_cycles_the_page_is_as_before(both, run_folder):
    shutil.rmtree(run_folder / "scores" / "main-cycles")
    page = write_report(run_folder).read_text()
    assert page == (both / "without.html").read_text()
    assert "Cycles" not in page
    assert "Images (differentiable renderer), found = centre within 1.0 m" in page


def test_missing_pictures_of_cycles_are_left_out(run_folder):
    shutil.rmtree(run_folder / "scores" / "main-cycles" / "pairs")
    page = write_report(run_folder).read_text()
    assert "No pairs are shown" in page
    assert len(table_of(page, "T-U on both renderers")) == 3


def test_the_page_and_the_tables_say_the_same_difference(both, page):
    """The page once had limits of its own, from the printed intervals."""
    cells = {row[0]: row[1:] for row in table_of(page, "T-U on both renderers")}
    change = cycles_columns(Reproduction(Results.open(both)), "T-U")
    low, high = (points(change[f"cycles_change_{end}"] / 100) for end in ("low", "high"))
    told = points(change["cycles_change"] / 100)
    assert cells["mean"][6] == f"{told} ({low} to {high})"


def change(first, second, half_width=0.07):
    difference = second - first
    return RendererChange(
        first, second, Interval(difference, difference - half_width, difference + half_width)
    )


NAN = float("nan")


@pytest.mark.parametrize(
    ("gross", "net", "said"),
    [
        (change(0.9, 0.6), change(0.85, 0.5), "The missing part leant on how the differentiable"),
        (change(0.9, 0.88), change(0.85, 0.6), "Random patterns hide more here"),
        (change(0.6, 0.9), change(0.5, 0.85), "Net success is higher"),
        (change(0.9, 0.86), change(0.85, 0.79), "cannot be told apart"),
        (change(0.9, 0.6), None, "The share hidden is lower"),
        (change(0.9, 0.6, NAN), change(0.85, 0.5, NAN), "The difference has no interval"),
        (None, None, "cannot be compared"),
    ],
)
def test_survival_in_words(gross, net, said):
    assert said in survival(made_row("T-U", "retinanet"), gross, net)


def test_points():
    assert (points(-0.217), points(0.04), points(-0.001), points(None)) == ("−22", "+4", "0", "–")
