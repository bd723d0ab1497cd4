"""One row per vehicle says whether it was detected in the original and in the adversarial image.

The rows are plain data and need no torch.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Meta

from skyproof.files import write_beside
from skyproof.ranges import Fraction, Metres, Name, WholeNumber, limits_of
from skyproof.results.pairs.parquet import read_table

Match = Literal["centre_1m", "iou_50", "centre_in_box"]
"""How a detection and a vehicle are paired, as `match_detections` says."""

MATCHES: tuple[Match, ...] = get_args(Match)

ORIGINAL = "original"
"""Stands where a camouflage's name would: nothing is changed."""

_Score = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Degrees = Annotated[float, Meta(ge=-1e4, le=1e4)]


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
        visible_fraction: share of the vehicle that is visible in the image; nan where not known.
        sun_elevation_deg, sun_azimuth_deg: the sun; azimuth from east towards north.
        tilt_deg, camera_azimuth_deg: the camera, off the vertical and towards which side.
        heading_deg: of the vehicle, from east towards north, in [0, 360).
        heading_to_sun_deg: angle between heading and sun azimuth, folded to [0, 180]; 0 is driving
            into the sun.
        condition: of the weather ("clear", "haze", ...).
    """

    scene: Name
    placement: WholeNumber
    vehicle: Name
    body_type: Name
    background: Name
    camouflage: Name
    renderer: Name
    detector: Name
    match: str
    detected_original: bool
    detected_adversarial: bool
    score_original: _Score
    score_adversarial: _Score
    distance_original_m: Metres
    distance_adversarial_m: Metres
    visible_fraction: Fraction
    sun_elevation_deg: _Degrees
    sun_azimuth_deg: _Degrees
    tilt_deg: _Degrees
    camera_azimuth_deg: _Degrees
    heading_deg: _Degrees
    heading_to_sun_deg: _Degrees
    condition: Name = "clear"


_UNDEFINED = ("distance_original_m", "distance_adversarial_m", "visible_fraction")
_ARROW_TYPES = {str: pa.string(), int: pa.int32(), bool: pa.bool_(), float: pa.float64()}
_HINTS = {**limits_of(Outcome), "match": Match}
_SCHEMA = pa.schema([(name, _ARROW_TYPES[kind]) for name, kind in get_type_hints(Outcome).items()])


def outcome_table(outcomes: Iterable[Outcome]) -> pa.Table:
    """Puts outcomes into a table, a column for each of their attributes."""
    # vars, not asdict: rows are flat, and there may be hundreds of thousands.
    return pa.Table.from_pylist([vars(outcome) for outcome in outcomes], schema=_SCHEMA)


def write_outcomes(path: Path, outcomes: Iterable[Outcome]) -> None:
    """Writes outcomes as one Parquet table, whole or not at all."""
    with write_beside(path) as temporary:
        pq.write_table(outcome_table(outcomes), temporary)


def read_outcomes(path: Path) -> list[Outcome]:
    """Reads what `write_outcomes` wrote.

    Raises:
        StoredFileError: as `read_outcome_table` does.
    """
    return [Outcome(**row) for row in read_outcome_table(path).to_pylist()]


def read_outcome_table(path: Path, columns: Sequence[str] = _SCHEMA.names) -> pa.Table:
    """Reads some columns of what `write_outcomes` wrote.

    Raises:
        StoredFileError: the file is missing, not Parquet, or has other columns or values that
            cannot be.
    """
    return read_table(path, _SCHEMA, _HINTS, undefined=_UNDEFINED, columns=columns)
