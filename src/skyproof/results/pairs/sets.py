"""What one detector makes of a whole set of images: average precision and false alarms.

The scores are kept in memory and on disk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, Name
from skyproof.results.rows_file import read_rows, write_rows


@dataclass(frozen=True)
class SetScore:
    """One detector on one whole set of images.

    Attributes:
        camouflage: as in the outcomes; "original" for the images without camouflage.
        renderer, detector, match: as in the outcomes.
        average_precision: in [0, 1]; nan where undefined.
        false_alarms_per_km2: at the frozen threshold; nan where undefined.
    """

    camouflage: Name
    renderer: Name
    detector: Name
    match: str
    average_precision: Fraction
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)]


def write_sets(path: Path, sets: Sequence[SetScore]) -> None:
    """Writes the scores as JSON; undefined ones become null."""
    write_rows(path, sets)


def read_sets(path: Path) -> list[SetScore]:
    """Reads what `write_sets` wrote.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    return read_rows(path, SetScore, "copy the whole folder again, or score again")
