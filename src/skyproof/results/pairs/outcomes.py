"""Outcomes: whether a detector found each vehicle without and with a camouflage. No torch."""

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
"""Match rule of `match_detections`."""

MATCHES: tuple[Match, ...] = get_args(Match)

ORIGINAL = "original"
"""Name of the unchanged images in place of a camouflage's."""

_Score = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Degrees = Annotated[float, Meta(ge=-1e4, le=1e4)]


@dataclass(frozen=True)
class Outcome:
    """One vehicle under one camouflage, for one detector and one match rule (section 5.1).

    Azimuths and headings turn from east towards north.

    Attributes:
        scene, placement: scene id and index in `Scene.placements`.
        vehicle, body_type: fleet id ("saloon-0017") and its part before the last hyphen.
        background: background tile of the scene, the cluster of the bootstrap.
        detected_original, detected_adversarial: matched by a detection at or above the frozen
            threshold.
        score_original, score_adversarial: score of the matched detection at any threshold; 0
            without one.
        distance_original_m, distance_adversarial_m: distance of the two centres in metres; nan
            without a match.
        visible_fraction: visible share of the vehicle; nan if unknown.
        tilt_deg: angle of the camera off the vertical.
        heading_to_sun_deg: angle between heading and sun azimuth, folded to [0, 180]; 0 is driving
            into the sun.
        condition: weather ("clear", "haze", ...).
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
    """Reads what `write_outcomes` wrote; raises as `read_outcome_table` does."""
    return [Outcome(**row) for row in read_outcome_table(path).to_pylist()]


def read_outcome_table(path: Path, columns: Sequence[str] = _SCHEMA.names) -> pa.Table:
    """Reads some columns of what `write_outcomes` wrote.

    Raises:
        StoredFileError: the file is missing, not Parquet, or has other columns or values that
            cannot be.
    """
    return read_table(path, _SCHEMA, _HINTS, undefined=_UNDEFINED, columns=columns)
