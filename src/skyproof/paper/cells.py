"""A table of a reproduction, as CSV and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof.results.statistics.intervals import Interval

__all__ = [
    "Table",
    "bracket",
    "in_percent",
    "interval_cells",
    "markdown",
    "number",
    "sign",
    "span",
    "word",
]

_RATES = (
    "easr",
    "easr_low",
    "easr_high",
    "easr_repeat_min",
    "easr_repeat_max",
    "random_easr",
    "net_easr",
    "net_easr_low",
    "net_easr_high",
    "apd",
)


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        name: of its file.
        rows: values by column, numbers unrounded; None where undefined.
    """

    name: str
    rows: Sequence[Mapping[str, Any]]

    @property
    def columns(self) -> list[str]:
        """Of all rows, in the order of their first use."""
        return list(dict.fromkeys(column for row in self.rows for column in row))

    def csv(self) -> str:
        """Comma-separated, numbers to four decimals, "–" where undefined."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            writer.writerow([_plain(row.get(column)) for column in self.columns])
        return text.getvalue()


def interval_cells(name: str, interval: Interval, scale: float = 1.0) -> dict[str, float]:
    """An interval's three columns."""
    return {
        name: scale * interval.estimate,
        f"{name}_low": scale * interval.low,
        f"{name}_high": scale * interval.high,
    }


def in_percent(row: Mapping[str, Any] | None) -> dict[str, Any]:
    """The numbers of one row of results, in percent and points; None where there is no row."""
    values = {name: (row or {}).get(name) for name in _RATES}
    return {"repeats": (row or {}).get("repeats")} | {
        name: None if value is None else 100 * value for name, value in values.items()
    }


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells under a header."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def bracket(row: Mapping[str, Any], key: str, *, digits: int = 1) -> str:
    """A value with its interval, which stands in the columns `<key>_low` and `<key>_high`."""
    value, low, high = row.get(key), row.get(f"{key}_low"), row.get(f"{key}_high")
    known = low is not None and high is not None and not (low != low or high != high)
    return number(value, digits) + (
        f" ({number(low, digits)} to {number(high, digits)})" if known else ""
    )


def span(low: float | None, high: float | None) -> str:
    """From the smallest to the largest."""
    return "–" if low is None or high is None else f"{number(low)} to {number(high)}"


def number(value: float | int | None, digits: int = 1) -> str:
    """A number with so many decimals and a true minus; a dash where undefined."""
    if value is None or value != value:
        return "–"
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


def sign(value: int | None) -> str:
    """A sum of signs."""
    return "–" if value is None else f"{value:+d}".replace("-", "−") if value else "0"


def word(value: bool | None) -> str:
    """Yes or no."""
    return "–" if value is None else "yes" if value else "no"


def _plain(value: Any) -> str:
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
