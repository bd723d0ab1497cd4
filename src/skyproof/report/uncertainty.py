"""The components of the intervals, and the sources of variation that they leave out."""

from __future__ import annotations

from dataclasses import dataclass

from skyproof.results.result import Headline, Result
from skyproof.results.results import Results


@dataclass(frozen=True)
class ErrorRow:
    """The standard errors of one camouflage's quoted rates, as fractions.

    Attributes:
        camouflage, renderer: which it is.
        tiles, vehicles, repeats: of its EASR, by what was drawn; None where that is left out.
        draws: of its net EASR, by the draws of the control; None where these are left out.
    """

    camouflage: str
    renderer: str
    tiles: float | None
    vehicles: float | None
    repeats: float | None
    draws: float | None


def error_rows(results: Results) -> list[ErrorRow]:
    """Gives one row per camouflage, of the mean over detectors or of the only one."""
    return [_error_row(headline) for headline in results.headlines()]


def left_out(row: Result) -> list[str]:
    """Names each source of variation that the intervals of a row do not cover."""
    sentences = []
    if "vehicles" not in row.easr.errors and "tiles" in row.easr.errors:
        sentences.append("One vehicle was tested, so the interval does not cover other vehicles.")
    if row.repeats == 1:
        sentences.append("One attack was run, so the interval does not cover other seeds.")
    if row.random is not None and row.random.draws == 1:
        sentences.append(
            "One random pattern was drawn, so the net interval does not cover other draws."
        )
    return sentences


def _error_row(headline: Headline) -> ErrorRow:
    errors = headline.row.easr.errors
    net = headline.row.net_easr
    return ErrorRow(
        str(headline.camouflage),
        headline.renderer,
        errors.get("tiles"),
        errors.get("vehicles"),
        errors.get("seeds"),
        None if net is None else net.errors.get("draws"),
    )
