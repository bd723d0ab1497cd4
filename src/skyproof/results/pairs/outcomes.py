"""One row per vehicle says whether it was detected in the original and in the adversarial image.

The rows are plain data and need no torch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

from skyproof.files import write_beside
from skyproof.results.pairs.parquet import read_table

__all__ = ["MATCHES", "Outcome", "read_outcomes", "write_outcomes"]

MATCHES: tuple[Literal["centre_1m"], Literal["iou_50"]] = ("centre_1m", "iou_50")


@dataclass(frozen=True)
class Outcome:
    """What became of one vehicle under one camouflage (section 5.1).

    It holds for one detector and one match criterion.

    Attributes:
        scene, placement: which vehicle: scene id and index in `Scene.placements`.
        vehicle, body_type: fleet id ("saloon-0017") and what stands before its last hyphen.
        background: the scene's background tile: the cluster of the bootstrap.
        camouflage, renderer, detector, match: what was compared; `match` is one of `MATCHES`.
        detected_original, detected_adversarial: matched by a detection at or above the frozen
            threshold.
        score_original, score_adversarial: score of the matched detection, whatever the threshold; 0
            where none.
        distance_original_m, distance_adversarial_m: from its centre to the vehicle's, metres; nan
            where none.
        visible_fraction: share of the vehicle inside the image; nan where not known.
        sun_elevation_deg, sun_azimuth_deg: the sun; azimuth from east towards north.
        tilt_deg, camera_azimuth_deg: the camera, off the vertical and towards which side.
        heading_deg: of the vehicle, from east towards north, in [0, 360).
        heading_to_sun_deg: angle between heading and sun azimuth, folded to [0, 180]; 0 is driving
            into the sun.
        condition: of the weather ("clear", "haze", ...).
    """

    scene: str
    placement: int
    vehicle: str
    body_type: str
    background: str
    camouflage: str
    renderer: str
    detector: str
    match: str
    detected_original: bool
    detected_adversarial: bool
    score_original: float
    score_adversarial: float
    distance_original_m: float
    distance_adversarial_m: float
    visible_fraction: float
    sun_elevation_deg: float
    sun_azimuth_deg: float
    tilt_deg: float
    camera_azimuth_deg: float
    heading_deg: float
    heading_to_sun_deg: float
    condition: str = "clear"


_ARROW_TYPES = {"str": pa.string(), "int": pa.int32(), "bool": pa.bool_(), "float": pa.float64()}
_SCHEMA = pa.schema(
    [(field.name, _ARROW_TYPES[str(field.type)]) for field in dataclasses.fields(Outcome)]
)


def write_outcomes(path: Path, outcomes: Iterable[Outcome]) -> None:
    """Writes outcomes as one Parquet table, whole or not at all."""
    # vars, not asdict: rows are flat, and there may be hundreds of thousands.
    table = pa.Table.from_pylist([vars(outcome) for outcome in outcomes], schema=_SCHEMA)
    with write_beside(path) as temporary:
        pq.write_table(table, temporary)


def read_outcomes(path: Path) -> list[Outcome]:
    """Reads what `write_outcomes` wrote.

    Raises:
        StoredFileError: the file is missing, not Parquet, or has other columns.
    """
    return [Outcome(**row) for row in read_table(path, _SCHEMA).to_pylist()]
