"""Outcomes: whether a detector found each vehicle without and with a camouflage. No torch.

Rates and intervals use their counts per background tile and vehicle of the fleet.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Int
from msgspec import Meta

from skyproof.camouflage.name import CamouflageName
from skyproof.documents import in_words
from skyproof.errors import StoredFileError
from skyproof.files import write_beside
from skyproof.ranges import Fraction, Match, Metres, Name, WholeNumber, limits_of
from skyproof.results.statistics.contrasts import Group
from skyproof.results.statistics.intervals import Sample
from skyproof.results.statistics.repeats import BESTS, DRAWS, GIVEN, SEARCHES, SEEDS, Repeat

MATCHES: tuple[Match, ...] = get_args(Match)

ORIGINAL = "original"
"""Name of the unchanged images in place of a camouflage's."""

REMEDY = "copy the whole folder again, or score again"
"""Advice on a damaged table of scores."""

Cell = tuple[str, str]
"""A background tile, and a vehicle of the fleet on it."""

_MOST_ROWS = 10_000_000
_LARGEST_BYTES = 2**32
_MOST_CELLS = 500_000
_MOST_COUNTS = 30_000_000
_CELL = ("background", "vehicle")
_FOUND = ("detected_original", "detected_adversarial")
_SCORES = ("score_original", "score_adversarial")

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
            threshold; the scores are at any threshold, and 0 without a match.
        distance_original_m, distance_adversarial_m: between both centres; nan without a match.
        visible_fraction: visible share of the vehicle; nan if unknown.
        tilt_deg: angle of the camera off the vertical.
        heading_to_sun_deg: angle between heading and sun azimuth, folded to [0, 180]; 0 is driving
            into the sun.
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
    """Puts outcomes into a table with one column per attribute."""
    # vars, not asdict: rows are flat, and there may be hundreds of thousands.
    return pa.Table.from_pylist([vars(outcome) for outcome in outcomes], schema=_SCHEMA)


def write_outcomes(path: Path, outcomes: Iterable[Outcome]) -> None:
    """Writes outcomes as one Parquet table, whole or not at all."""
    with write_beside(path) as temporary:
        pq.write_table(outcome_table(outcomes), temporary)


def read_outcomes(path: Path) -> list[Outcome]:
    """Reads what `write_outcomes` wrote."""
    return [Outcome(**row) for row in read_outcome_table(path).to_pylist()]


def read_outcome_table(path: Path, columns: Sequence[str] = _SCHEMA.names) -> pa.Table:
    """Reads some columns of what `write_outcomes` wrote; another form is refused."""
    return read_table(path, _SCHEMA, _HINTS, undefined=_UNDEFINED, columns=columns)


def read_table(
    path: Path,
    schema: pa.Schema,
    hints: Mapping[str, Any],
    *,
    undefined: Collection[str] = (),
    columns: Sequence[str] | None = None,
) -> pa.Table:
    """Reads columns of a Parquet table with this schema; only `undefined` columns may hold nan."""
    if not path.exists():
        raise StoredFileError(f"{path} is missing; {REMEDY}, or give another run folder.")
    try:
        wanted = list(schema.names if columns is None else columns)
        table = _read(path, schema, wanted)
        for name in wanted:
            _check(table[name], hints.get(name), name in undefined)
        return table.cast(pa.schema([schema.field(name) for name in wanted]))
    except _UnfitTable as unfit:
        said = str(unfit)
    except msgspec.ValidationError as error:
        reason = in_words(str(error).partition(" - at ")[0]).partition(": ")[2]
        said = f"has a value in its column {name} that cannot be ({reason})"
    except Exception as error:
        # Parquet readers raise many kinds of exceptions on damaged files.
        said = f"is not a readable Parquet file ({' '.join(str(error).split())[:200]})"
    raise StoredFileError(f"{path} {said.rstrip('.')}; {REMEDY}.")


class _UnfitTable(Exception):
    """Raised if a table is not as expected; its text says why."""


def _read(path: Path, schema: pa.Schema, columns: list[str]) -> pa.Table:
    """Reads a table with its texts as dictionaries, so memory holds each long text only once."""
    metadata = pq.read_metadata(path)
    stored = metadata.schema.to_arrow_schema()
    if not stored.equals(schema):
        differing = ", ".join(sorted(set(schema.names) ^ set(stored.names))) or "their types"
        raise _UnfitTable(f"has other columns than this version writes ({differing[:200]})")
    size = sum(
        metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups)
    )
    if metadata.num_rows > _MOST_ROWS or size > _LARGEST_BYTES:
        raise _UnfitTable(f"has {metadata.num_rows:,} rows, more than are read ({_MOST_ROWS:,})")
    texts = [field.name for field in schema if field.type == pa.string()]
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        return file.read(columns=columns)


def _check(column: pa.ChunkedArray, hint: Any, may_be_undefined: bool) -> None:
    if column.null_count:
        raise _UnfitTable("has empty cells")
    if hint is None or not len(column):
        return
    if pa.types.is_dictionary(column.type):
        for chunk in column.chunks:
            msgspec.convert(chunk.dictionary.to_pylist(), list[hint])
        return
    if pa.types.is_floating(column.type):
        column = column.filter(pc.invert(pc.is_nan(column))) if may_be_undefined else column
        if not len(column):
            return
        if pc.any(pc.is_nan(column)).as_py():
            raise _UnfitTable("holds numbers that are not finite")
    ends = pc.min_max(column).as_py()
    msgspec.convert([ends["min"], ends["max"]], list[hint])


class Series(NamedTuple):
    """Names of one series of outcomes."""

    camouflage: str
    renderer: str
    detector: str
    match: str


@dataclass(frozen=True)
class OutcomeCounts:
    """Outcomes counted per series and cell: vehicles in sight, detected in both, lost, gained.

    `ends` are the series at the other thresholds that chance might have set.
    """

    cells: tuple[Cell, ...]
    series: Mapping[Series, Int[np.ndarray, "N 4"]]
    ends: Sequence[Mapping[Series, Int[np.ndarray, "N 4"]]] = ()

    @property
    def tiles(self) -> int:
        """Number of background tiles."""
        return len({tile for tile, _ in self.cells})

    def group(
        self, keys: Sequence[Series], sample: Sample, of: Sequence[str] = (), *, given: bool = False
    ) -> Group:
        """Groups some series, for the mean of their rates.

        If they are `given`, the rates describe these very camouflages and no other draw or seed.
        """
        counts, *ends = (
            np.stack([series[key][:, 1:] for key in keys]) for series in (self.series, *self.ends)
        )
        repeats = [repeat_of(key.camouflage) for key in keys]
        if given:
            repeats = [replace(each, kind=GIVEN) for each in repeats]
        return Group(counts, sample, [[each] for each in repeats], of, ends)

    def of(self, renderer: str, match: str) -> "OutcomeCounts":
        """Returns the series of one renderer and match rule, on the cells that they show."""
        keys = [key for key in self.series if (key.renderer, key.match) == (renderer, match)]
        shown = np.any([self.series[key][:, 0] > 0 for key in keys], axis=0)
        cells = tuple(itertools.compress(self.cells, shown))
        series, *ends = (
            {key: own[key][shown] for key in keys} for own in (self.series, *self.ends)
        )
        return OutcomeCounts(cells, series, ends)


def repeat_of(camouflage: str) -> Repeat:
    """Reads from a name what the camouflage repeats, and how: "R-U-1" is a draw of "R-U"."""
    name = CamouflageName.read(camouflage)
    kind = DRAWS if name.random else SEEDS
    if name.choice is not None:
        kind = {"plain": GIVEN, "search": SEARCHES}.get(name.choice, BESTS)
    elif name.kind == "other" and not name.repeat:
        kind = GIVEN
    return Repeat(str(name.pooled), name.repeat, kind)


def read_counts(path: Path, thresholds: Mapping[str, float] | None = None) -> OutcomeCounts:
    """Counts the outcomes in a file of `write_outcomes`, with series in order of first occurrence.

    A vehicle is found as the file says, or at other `thresholds` by detector, all above 0, and then
    detectors without one are left out. Matching is greedy by score, so matches stay the same.
    """
    columns = _FOUND if thresholds is None else _SCORES
    table = read_outcome_table(path, [*Series._fields, *_CELL, *columns])
    least: Any = True
    if thresholds is not None:
        table = table.filter(pc.is_in(table["detector"], pa.array(list(thresholds))))
        least = np.array([thresholds[name] for name in table["detector"].to_pylist()])
    keys, first, series = _numbered(table, Series._fields)
    found, _, place = _numbered(table, _CELL)
    pairs = [(tile, vehicle) for tile, vehicle in found]
    cells = sorted(pairs)
    if len(cells) > _MOST_CELLS or len(cells) * len(keys) > _MOST_COUNTS:
        raise StoredFileError(
            f"{path} holds {len(keys):,} series of {len(cells):,} vehicles on tiles, more than "
            f"the {_MOST_COUNTS:,} counts of {_MOST_CELLS:,} that are read; score fewer at once."
        )
    row_of = {cell: row for row, cell in enumerate(cells)}
    rows = np.array([row_of[cell] for cell in pairs], dtype=np.int64)[place]
    position = series * len(cells) + rows
    before, after = (table[name].to_numpy() >= least for name in columns)
    shown = (np.ones_like(before), before & after, before & ~after, ~before & after)
    counts = [
        np.bincount(position[mask], minlength=len(keys) * len(cells)).reshape(len(keys), len(cells))
        for mask in shown
    ]
    dense = np.stack(counts, axis=-1).astype(np.int64)
    named = {Series(*keys[row]): dense[row] for row in np.argsort(first)}
    return OutcomeCounts(tuple(cells), named)


def _numbered(
    table: pa.Table, names: Sequence[str]
) -> tuple[list[tuple[str, ...]], Int[np.ndarray, " K"], Int[np.ndarray, " rows"]]:
    """Returns the K distinct rows of some columns, their first positions, and each row's number."""
    columns = [table[name].combine_chunks().dictionary_encode() for name in names]
    sizes = [max(len(column.dictionary), 1) for column in columns]
    codes = np.ravel_multi_index([column.indices.to_numpy() for column in columns], sizes)
    kinds, first, which = np.unique(codes, return_index=True, return_inverse=True)
    places = np.unravel_index(kinds, sizes)
    values = [
        column.dictionary.take(place).to_pylist()
        for column, place in zip(columns, places, strict=True)
    ]
    return list(zip(*values, strict=True)), first, which.reshape(-1)


def count_cells(outcomes: Sequence[Outcome], cells: Mapping[Cell, int]) -> Int[np.ndarray, "N 3"]:
    """Counts the pairs (both, lost, gained) per tile and vehicle, by the rows in `cells`."""
    pairs = (
        ((each.background, each.vehicle), each.detected_original, each.detected_adversarial)
        for each in outcomes
    )
    return count_pairs(pairs, cells)


def count_pairs(
    pairs: Iterable[tuple[Cell, bool, bool]], cells: Mapping[Cell, int]
) -> Int[np.ndarray, "N 3"]:
    """Counts (both, lost, gained) per cell from vehicles found or missed before and after."""
    counts = np.zeros((len(cells), 3), dtype=np.int64)
    for cell, before, after in pairs:
        if before:
            counts[cells[cell], 0 if after else 1] += 1
        elif after:
            counts[cells[cell], 2] += 1
    return counts
