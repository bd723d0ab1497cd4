"""Every number in the tables and lists of the page of results is in the CSV file it names.

A table's files are those that the paragraph above it links; cells that equal a value of these files
choose the rows, and so do code spans after a link. A list item names its files and rows in the same
way. Numbers in code spans, links and names are not read, nor is other text.
"""

import csv
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "results" / "README.md"
_FEWEST_CHECKED = 60
_REFERENCE = re.compile(r"\[[^\]]*\]\((?P<file>[\w./-]+\.csv)\)(?P<rows>(?:[\s,:]|`[^`]*`)*)")
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`[^`]*`")
_NAME = re.compile(r"\b(?:YOLOv5|P1|PM\\?\*?|[TRSC]-[A-Za-z-]+@[\d.]+|\d{4}-\d\d-\d\d)\b")
_NUMBER = re.compile(r"(?<![\w.])[−-]?\d+(?:\.\d+)?(?![\w])")

Row = dict[str, str]


def _tables(page: str) -> list[tuple[str, list[str]]]:
    """The rows of all tables below a paragraph that links a CSV file, with that paragraph."""
    blocks = [" ".join(block.split()) for block in page.split("\n\n")]
    return [
        (above, table.strip().split("\n")[2:])
        for above, table in zip(blocks, page.split("\n\n")[1:], strict=False)
        if table.startswith("| ") and _REFERENCE.search(above)
    ]


def _statements(page: str) -> list[str]:
    """The items of all lists, each on one line."""
    found: list[str] = []
    for block in page.split("\n\n"):
        if block.startswith("- "):
            found += [" ".join(item.split()) for item in re.split(r"^- ", block, flags=re.M)]
    return [statement for statement in found if statement]


def _values(row: Row) -> set[str]:
    """What a row of a file may be named by."""
    shape = {f"{row['attack']}@{float(row['pm']):g}"} if "pm" in row else set()
    return {*row.values()} | shape


def _rows(text: str, folder: Path) -> list[Row]:
    """What a text refers to."""
    found = []
    for reference in _REFERENCE.finditer(text):
        with (folder / reference["file"]).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        named = re.findall(r"`([^`]+)`", reference["rows"])
        for name in named:
            assert any(name in _values(row) for row in rows), f"{reference['file']} has no {name}"
        found += [row for row in rows if not named or set(named) & _values(row)]
    return found


def _numbers(text: str) -> list[str]:
    """What a text says in figures."""
    text = _REFERENCE.sub(" ", text)
    text = _LINK.sub(lambda link: link["text"], text)
    return _NUMBER.findall(_NAME.sub(" ", _CODE.sub(" ", text)))


def _is_told(number: str, rows: list[Row]) -> bool:
    """Whether a value of the rows, or a hundred times it, rounds to the number as written."""
    decimals = len(number.partition(".")[2])
    written = float(number.replace("−", "-"))
    half_unit = 0.5 * 10**-decimals
    for row in rows:
        for cell in row.values():
            try:
                value = float(cell)
            except ValueError:
                continue
            # Cells themselves are rounded to four decimals.
            if min(abs(value - written), abs(100 * value - written)) <= half_unit + 1e-4:
                return True
    return False


def _of_table(line: str, rows: list[Row]) -> list[Row]:
    """The rows of the files that the names in a line of a table choose."""
    cells = {cell.strip().strip("`") for cell in line.split("|")}
    names = {cell for cell in cells if cell and not _NUMBER.match(cell) and cell != "–"}
    names &= set().union(*map(_values, rows))
    assert names, f"no row is named in {line}"
    return [row for row in rows if names <= _values(row)]


def _untold(page: str, folder: Path) -> list[str]:
    """Numbers of tables and statements that are not in the files they name."""
    checked = [(text, _rows(text, folder)) for text in _statements(page)]
    for above, lines in _tables(page):
        rows = _rows(above, folder)
        checked += [(line, _of_table(line, rows)) for line in lines]
    return [
        f"{number} in “{text}”"
        for text, rows in checked
        for number in _numbers(text)
        if not _is_told(number, rows)
    ]


def test_every_number_of_the_page_is_in_the_file_that_it_names() -> None:
    page = PAGE.read_text(encoding="utf-8")

    assert _untold(page, PAGE.parent) == []
    lines = [line for _, lines in _tables(page) for line in lines]
    with_numbers = [text for text in [*lines, *_statements(page)] if _numbers(text)]
    assert len(with_numbers) >= _FEWEST_CHECKED


@pytest.mark.parametrize(
    ("statement", "wrong"),
    [
        ("- Hidden: 87 % ([a](a.csv): `T-U`).", 0),
        ("- Hidden: 86 % ([a](a.csv): `T-U`).", 1),
        ("- Hidden: 41 % ([a](a.csv): `T-U`).", 1),
        ("- Hidden: 41 % ([a](a.csv)).", 0),
        ("- By share 0.87 and −3.2 points ([a](a.csv) `T-U`).", 0),
        ("- By 3.2 points ([a](a.csv) `T-U`).", 1),
        ("- Two of them hide 40\n  % and 87.0 ([a](a.csv): `T-U`, `T-Ma`).", 2),
        ("- Of no file: 5 %.", 1),
        ("- At `PM 0.4`, T-U@0.2 and YOLOv5 nothing.", 0),
        (
            "Rates ([a](a.csv)):\n\n| a | b |\n| -- | -- |\n| T-U | 87 (−3 to 87) |\n| T-Ma | 41 |",
            0,
        ),
        ("Rates ([a](a.csv)):\n\n| a | b |\n| -- | -- |\n| T-U | 41 |\n| `T-Ma` | 87 |", 2),
    ],
)
def test_a_number_that_is_not_there_is_found(tmp_path: Path, statement: str, wrong: int) -> None:
    (tmp_path / "a.csv").write_text("attack,easr,net\nT-U,0.8684,-3.2\nT-Ma,41.2,–\n")

    assert len(_untold(f"# Page\n\n## What it says\n\n{statement}\n", tmp_path)) == wrong


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("- 87 % ([a](a.csv): `T-Pix`).", "has no T-Pix"),
        ("Rates ([a](a.csv)):\n\n| a | b |\n| -- | -- |\n| T-Pix | 87 |", "no row is named"),
    ],
)
def test_a_row_that_is_not_there_is_found(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "a.csv").write_text("attack,easr\nT-U,0.8684\n")

    with pytest.raises(AssertionError, match=complaint):
        _untold(f"## What it says\n\n{text}\n", tmp_path)
