"""Transfer: camouflages optimised against some detectors, judged by all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.reproduction.cells import Grid, Heading, Part, Table, bracket, interval_cells
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.rows import MAIN_MATCH, MEAN, Row
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name


def transfer_part(run: Reproduction) -> Part:
    """Sets the detectors attacked (rows) against those that judged (columns)."""
    rows = _rows(run)
    if not rows:
        return Part([Table("transfer", rows)])
    cells = [
        [
            row["attack"],
            ", ".join(map(detector_name, row["attacked_on"].split())),
            *(bracket(row, detector) for detector in run.detectors),
        ]
        for row in rows
    ]
    header = [
        "attack",
        "learnt on",
        *(f"EASR on {detector_name(detector)}" for detector in run.detectors),
    ]
    return Part([Table("transfer", rows)], [Heading("Transfer"), Grid(header, cells)])


def _rows(run: Reproduction) -> list[dict[str, Any]]:
    """Sets the detectors attacked (rows) against those that judged (columns)."""
    names = run.results.names
    variants = [name for name in names if name.variant.startswith(("on_", "without_"))]
    attacked = {
        CamouflageName.read(name): tuple(record.attack.detectors)
        for name, record in run.records.items()
        if record.attack is not None
    }
    rows = []
    for base in dict.fromkeys(name.base for name in variants):
        # Copies kept on the way are variants too, but not of what was attacked.
        matrix = transfer_matrix(
            [row for row in run.results.rows if row.camouflage in (base, *variants)],
            attacked,
            base=base,
        )
        for cells in matrix:
            row: dict[str, Any] = {"attack": str(base), "attacked_on": " ".join(cells[0].attacked)}
            for cell in cells:
                row |= interval_cells(cell.detector, cell.easr, 100.0)
            rows.append(row)
    return rows


@dataclass(frozen=True)
class Cell:
    """One camouflage before one detector.

    Attributes:
        camouflage: row of the table of results; repeats are pooled.
        attacked: the detectors it was optimised against, sorted.
        detector: the one that judges.
        easr: a fraction.
    """

    camouflage: CamouflageName
    attacked: tuple[str, ...]
    detector: str
    easr: Interval


def transfer_matrix(
    rows: Sequence[Row],
    attacked: Mapping[CamouflageName, Sequence[str]],
    *,
    base: CamouflageName,
    renderer: str = "torch",
    match: str = MAIN_MATCH,
) -> list[list[Cell]]:
    """Gives the matrix of attacked-on by evaluated-on for one kind of camouflage and its variants.

    Args:
        rows: of `summarise`.
        attacked: by camouflage (with or without repeat), the detectors it was optimised against.
        base: the kind: "T-U" takes "T-U" and its variants "T-U_on_...", "T-U_without_...".
        renderer, match: which of the rows.

    Returns:
        One list per camouflage, single detectors first, then larger sets; in each one cell per
        judging detector, in the order of `rows`.

    Raises:
        ConfigurationError: no row of that kind, unknown attacked detectors, repeats that attacked
            different ones, or a judge that has not judged all.
    """
    of_row: dict[CamouflageName, tuple[str, ...]] = {}
    for name, detectors in attacked.items():
        known = of_row.setdefault(name.pooled, tuple(sorted(detectors)))
        if known != tuple(sorted(detectors)):
            raise ConfigurationError(
                f"Repeats of {name.pooled} attacked different detectors; give them different names."
            )
    chosen = [
        row
        for row in rows
        if (row.renderer, row.match) == (renderer, match)
        and row.camouflage.base == base
        and row.detector != MEAN
    ]
    if not chosen:
        raise ConfigurationError(
            f"The table of results has no row of {base} by {match} under {renderer}; score it."
        )
    judges = list(dict.fromkeys(row.detector for row in chosen))
    by_place = {(row.camouflage, row.detector): row for row in chosen}
    names = list(dict.fromkeys(row.camouflage for row in chosen))
    for name in names:
        if not of_row.get(name):
            raise ConfigurationError(
                f"It is not known which detectors {name} attacked; give its camouflage folder."
            )
        missing = next((judge for judge in judges if (name, judge) not in by_place), None)
        if missing:
            raise ConfigurationError(
                f"{missing} has not judged {name}; score every camouflage by the same detectors."
            )
    names.sort(key=lambda name: (len(of_row[name]), of_row[name]))
    return [[_cell(by_place[name, judge], of_row[name]) for judge in judges] for name in names]


def _cell(row: Row, attacked: tuple[str, ...]) -> Cell:
    return Cell(
        camouflage=row.camouflage,
        attacked=attacked,
        detector=row.detector,
        easr=row.easr,
    )
