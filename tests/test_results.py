"""The page of results says what its tables say: every number of a statement is in its CSV file.

A statement is an item of a list. It names its file by a link, and after it, in code spans, the rows
that it speaks of; where none are named, all count. Numbers in code spans, links and names are not
read, nor is what stands outside of lists, which tells how the run was made.
"""

import csv
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "results" / "README.md"
_FEWEST_STATEMENTS = 10
_SECTIONS_WITHOUT = ("How it was run",)
_REFERENCE = re.compile(r"\[[^\]]*\]\((?P<file>[\w./-]+\.csv)\)(?P<rows>(?:[\s,:]|`[^`]*`)*)")
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`[^`]*`")
_NAME = re.compile(r"\b(?:YOLOv5|P1|PM\\?\*?|[TRSC]-[A-Za-z-]+@[\d.]+|\d{4}-\d\d-\d\d)\b")
_NUMBER = re.compile(r"(?<![\w.])[−-]?\d+(?:\.\d+)?(?![\w])")


def _statements(page: str) -> list[str]:
    """The items of all lists, each on one line, but for those that tell how the run was made."""
    found: list[str] = []
    for section in re.split(r"^## ", page, flags=re.MULTILINE)[1:]:
        if section.startswith(_SECTIONS_WITHOUT):
            continue
        for block in section.split("\n\n"):
            if block.lstrip().startswith("- "):
                found += [" ".join(item.split()) for item in re.split(r"^- ", block, flags=re.M)]
    return [statement for statement in found if statement]


def _rows(statement: str, folder: Path) -> list[dict[str, str]]:
    """What a statement refers to."""
    found = []
    for reference in _REFERENCE.finditer(statement):
        with (folder / reference["file"]).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        named = re.findall(r"`([^`]+)`", reference["rows"])
        for name in named:
            assert any(name in row.values() for row in rows), f"{reference['file']} has no {name}"
        found += [row for row in rows if not named or set(named) & set(row.values())]
    return found


def _numbers(statement: str) -> list[str]:
    """What a statement says in figures."""
    text = _REFERENCE.sub(" ", statement)
    text = _LINK.sub(lambda link: link["text"], text)
    return _NUMBER.findall(_NAME.sub(" ", _CODE.sub(" ", text)))


def _is_told(number: str, rows: list[dict[str, str]]) -> bool:
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


def _untold(page: str, folder: Path) -> list[str]:
    """Numbers of statements that are not in the files they name."""
    return [
        f"{number} in “{statement}”"
        for statement in _statements(page)
        for number in _numbers(statement)
        if not _is_told(number, _rows(statement, folder))
    ]


def test_every_number_of_the_page_is_in_the_file_that_it_names() -> None:
    page = PAGE.read_text(encoding="utf-8")

    assert _untold(page, PAGE.parent) == []
    with_numbers = [statement for statement in _statements(page) if _numbers(statement)]
    assert len(with_numbers) >= _FEWEST_STATEMENTS


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
    ],
)
def test_a_number_that_is_not_there_is_found(tmp_path: Path, statement: str, wrong: int) -> None:
    (tmp_path / "a.csv").write_text("attack,easr,net\nT-U,0.8684,-3.2\nT-Ma,41.2,–\n")

    assert len(_untold(f"# Page\n\n## What it says\n\n{statement}\n", tmp_path)) == wrong


def test_a_row_that_is_not_there_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("attack,easr\nT-U,0.8684\n")

    with pytest.raises(AssertionError, match="has no T-Pix"):
        _untold("## What it says\n\n- 87 % ([a](a.csv): `T-Pix`).\n", tmp_path)
