"""Transfer: camouflages optimised against some detectors, scored by all."""

from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.reproduction.cells import Cell, Table, TextTable, Topic, interval_cells, rate
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.result import MAIN_MATCH, MEAN, Result
from skyproof.results.results import RENDERER
from skyproof.words import detector_name

_OF_SOME = ("on_", "without_")
"""Prefixes of variants that were optimised against some of the detectors."""


def transfer_part(run: Reproduction) -> Topic:
    """Sets the attacked detectors (rows) against those that score (columns)."""
    attacked = {
        CamouflageName.read(name): tuple(record.attack.detectors)
        for name, record in run.results.records.items()
        if record.attack is not None
    }
    every = [*run.results.rows, *run.results.equal_alarms]
    of_some = (name for name in run.results.names if name.variant.startswith(_OF_SOME))
    rows = [
        {**row, "operating_point": point}
        for base in dict.fromkeys(name.base for name in of_some)
        for point in dict.fromkeys(row.operating_point for row in every)
        for row in transfer_rows(
            [row for row in every if row.operating_point == point], attacked, base
        )
    ]
    if not rows:
        return Topic([Table("transfer", rows)])
    columns: list[tuple[str, str | Cell]] = [
        ("attack", "attack"),
        ("threshold", lambda row: row["operating_point"].replace("_per_", "/")),
        ("learnt on", lambda row: ", ".join(map(detector_name, row["attacked_on"].split()))),
        *((f"EASR on {detector_name(each)}", rate(each)) for each in run.detectors),
    ]
    return Topic.of("Transfer", {"transfer": rows}, TextTable.of(rows, columns))


def transfer_rows(
    rows: Sequence[Result], attacked: Mapping[CamouflageName, Sequence[str]], base: CamouflageName
) -> list[dict[str, Any]]:
    """Returns EASR in percent by attacked and scoring detectors, for one attack and its variants.

    Single detectors come first ("T-U_on_..."), then larger sets ("T-U_without_...", "T-U").
    """
    of_row: dict[CamouflageName, tuple[str, ...]] = {}
    for name, detectors in attacked.items():
        known = of_row.setdefault(name.pooled, tuple(sorted(detectors)))
        if known != tuple(sorted(detectors)):
            raise ConfigurationError(
                f"Repeats of {name.pooled} attacked different detectors; give them different names."
            )
    easr = {
        (row.camouflage, row.detector): row.easr
        for row in rows
        if (row.renderer, row.match) == (RENDERER, MAIN_MATCH)
        and row.camouflage.base == base
        # Intermediate copies are variants, too, but not by the detectors attacked.
        and (not row.camouflage.variant or row.camouflage.variant.startswith(_OF_SOME))
        and row.detector != MEAN
    }
    scoring = dict.fromkeys(detector for _, detector in easr)
    names = dict.fromkeys(name for name, _ in easr)
    for name in names:
        if not of_row.get(name):
            raise ConfigurationError(
                f"It is not known which detectors {name} attacked; give its camouflage folder."
            )
        missing = next((each for each in scoring if (name, each) not in easr), None)
        if missing:
            raise ConfigurationError(
                f"{missing} has not scored {name}; score every camouflage by the same detectors."
            )
    found = []
    for name in sorted(names, key=lambda name: (len(of_row[name]), of_row[name])):
        row: dict[str, Any] = {"attack": str(base), "attacked_on": " ".join(of_row[name])}
        for each in scoring:
            row |= interval_cells(each, easr[name, each], 100.0)
        found.append(row)
    return found
