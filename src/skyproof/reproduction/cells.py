"""Tables of numbers as CSV, and a page of headings, paragraphs and tables as Markdown."""

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof.results.operating_points import EQUAL_ALARMS
from skyproof.results.result import Result
from skyproof.results.results import Results
from skyproof.results.rows_file import interval_columns
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name

_STAR = re.compile(r"(?<!\*)\*(?!\*)")
_NET = "net_strongest_control_easr"
_RATES = (
    *("found_before", "easr", "easr_low", "easr_high", "easr_repeat_min", "easr_repeat_max"),
    *("random_easr", "net_easr", "net_easr_low", "net_easr_high"),
    *("strongest_control_easr", "net_strongest_control_easr"),
    *("net_strongest_control_easr_low", "net_strongest_control_easr_high"),
    *("drawn_shape_easr", "net_drawn_shape_easr"),
    *("net_drawn_shape_easr_low", "net_drawn_shape_easr_high", "apd"),
)


@dataclass(frozen=True)
class Table:
    """One table of a file: values by column, numbers unrounded; None where undefined."""

    name: str
    rows: Sequence[Mapping[str, Any]]

    @property
    def columns(self) -> list[str]:
        """The columns of all rows, in the order of their first use."""
        return list(dict.fromkeys(column for row in self.rows for column in row))

    def csv(self) -> str:
        """Writes comma-separated values, numbers to four decimals, "–" where undefined."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        columns = self.columns
        writer.writerow(columns)
        writer.writerows([_plain(row.get(column)) for column in columns] for row in self.rows)
        return text.getvalue()


def interval_cells(name: str, interval: Interval, scale: float = 1.0) -> dict[str, float]:
    """Returns an interval's three columns."""
    columns = interval_columns(name, interval)
    return {column: scale * value for column, value in columns.items()}


def in_percent(row: Result | None) -> dict[str, Any]:
    """Returns a row of results in percent and points; None where there is no row."""
    values = {} if row is None else row.json()
    rates = {name: values.get(name) for name in _RATES}
    told = ("repeats", "random_draws", "strongest_control")
    return {name: values.get(name) for name in told} | {
        name: None if value is None else 100 * value for name, value in rates.items()
    }


def at_equal_alarms(results: Results, row: Result | None) -> dict[str, Any]:
    """Returns the same row at equal false alarms in percent and points, where it is known."""
    cells: dict[str, Any] = {}
    for name in EQUAL_ALARMS:
        at = None if row is None else results.at(row, name)
        if at is not None:
            cells[f"found_before_at_{name}"] = 100 * at.found_before
            cells |= interval_cells(f"easr_at_{name}", at.easr, 100.0)
            if at.strongest is not None:
                cells |= interval_cells(f"{_NET}_at_{name}", at.strongest.net, 100.0)
    return cells


def equal_alarm_columns(rows: Sequence[Mapping[str, Any]]) -> "list[tuple[str, Cell]]":
    """Returns the columns that `at_equal_alarms` filled in any of the rows."""
    return [
        (f"{words} at {alarms}/km²", rate(f"{key}_at_{name}"))
        for name, alarms in EQUAL_ALARMS.items()
        for key, words in (("easr", "EASR"), (_NET, "net of best control"))
        if any(f"{key}_at_{name}" in row for row in rows)
    ]


@dataclass(frozen=True)
class Heading:
    """A heading of a page of tables; level 2 or 3."""

    text: str
    level: int = 2


Cell = Callable[[Mapping[str, Any]], str]
"""What a column shows of a row."""


@dataclass(frozen=True)
class TextTable:
    """A table of a page, as words."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(
        cls, rows: Iterable[Mapping[str, Any]], columns: Sequence[tuple[str, str | Cell]]
    ) -> "TextTable":
        """Shows columns of rows, each under its heading; a key stands for the value as it is."""
        cells = [
            [str(row[cell]) if isinstance(cell, str) else cell(row) for _, cell in columns]
            for row in rows
        ]
        return cls([heading for heading, _ in columns], cells)

    def markdown(self) -> str:
        """Writes the grid in Markdown."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        return "\n".join("| " + " | ".join(line) + " |" for line in cells)


@dataclass(frozen=True)
class Figure:
    """A picture of a page: its bytes by file ending, none if the run lacks its data."""

    name: str
    caption: str
    files: Mapping[str, bytes]


Block = Heading | TextTable | Figure | str
"""A part of a page; a string is a paragraph."""


@dataclass(frozen=True)
class Topic:
    """A topic's tables and its blocks on the page; both are empty if a run has nothing on it."""

    tables: Sequence[Table] = ()
    blocks: Sequence[Block] = ()

    @classmethod
    def of(
        cls, heading: str, tables: Mapping[str, Sequence[Mapping[str, Any]]], *blocks: Block
    ) -> "Topic":
        """Returns a topic of rows by table name, and of blocks below a heading; "" is left out."""
        said = [block for block in blocks if block]
        return cls([Table(*table) for table in tables.items()], [Heading(heading), *said])


def as_markdown(blocks: Sequence[Block]) -> str:
    """Writes a page of blocks in Markdown."""
    parts = []
    for block in blocks:
        if isinstance(block, Heading):
            parts.append("#" * block.level + " " + block.text)
        elif isinstance(block, TextTable):
            parts.append(block.markdown())
        elif isinstance(block, Figure):
            parts.append(f"![{block.caption}]({block.name}.png)")
        else:
            # A single star is meant literally; two mark bold text.
            parts.append(_STAR.sub(r"\\*", block))
    return "\n\n".join(parts) + "\n"


def rate(key: str, digits: int = 1) -> Cell:
    """Shows a column's value with its interval, of the columns `<key>_low` and `<key>_high`."""

    def cell(row: Mapping[str, Any]) -> str:
        limits = [number(row.get(f"{key}_{end}"), digits) for end in ("low", "high")]
        known = number(None) not in limits
        return number(row.get(key), digits) + (f" ({' to '.join(limits)})" if known else "")

    return cell


def value(key: str, digits: int = 1) -> Cell:
    """Shows a column's number."""
    return lambda row: number(row.get(key), digits)


def detector_of(row: Mapping[str, Any]) -> str:
    """Shows the name of a row's detector."""
    return detector_name(row["detector"])


def span(low: float | None, high: float | None) -> str:
    """Writes a range from the smallest to the largest."""
    return "–" if low is None or high is None else f"{number(low)} to {number(high)}"


def number(value: float | int | None, digits: int = 1) -> str:
    """Writes a number with so many decimals and a true minus; a dash where undefined."""
    if value is None or value != value:
        return "–"
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


def sign(value: int | None) -> str:
    """Writes a sum of signs."""
    return "–" if value is None else f"{value:+d}".replace("-", "−") if value else "0"


def _plain(value: Any) -> str:
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
