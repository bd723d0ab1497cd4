"""What one detector makes of a whole set of images: average precision and false alarms.

The scores are kept in memory and on disk.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_json

__all__ = ["ORIGINAL", "SetScore", "read_sets", "write_sets"]

ORIGINAL = "original"


@dataclass(frozen=True)
class SetScore:
    """One detector on one whole set of images.

    Attributes:
        camouflage: as in the outcomes; "original" for the images without camouflage.
        renderer, detector, match: as in the outcomes.
        average_precision: in [0, 1]; nan where undefined.
        false_alarms_per_km2: at the frozen threshold; nan where undefined.
    """

    camouflage: str
    renderer: str
    detector: str
    match: str
    average_precision: float
    false_alarms_per_km2: float


def write_sets(path: Path, sets: Sequence[SetScore]) -> None:
    """Writes the scores as JSON; undefined ones become null."""
    rows = [dataclasses.asdict(score) for score in sets]
    write_json(
        path,
        {
            "rows": [
                {key: None if value != value else value for key, value in row.items()}
                for row in rows
            ]
        },
    )


def read_sets(path: Path) -> list[SetScore]:
    """Reads what `write_sets` wrote.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    content = read_json(path)

    def score(row: dict[str, Any]) -> SetScore:
        values: dict[str, Any] = {
            key: math.nan if value is None else value for key, value in row.items()
        }
        return SetScore(**values)

    try:
        return [score(row) for row in content["rows"]]
    except (TypeError, KeyError, AttributeError) as error:
        raise StoredFileError(
            f"{path} is not of the form this version writes; run the evaluation again."
        ) from error
