"""The printed summaries of imagery that was tiled or cleared."""

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from skyproof.imagery.notes import ImageNote
from skyproof.imagery.tiles.tiling import TilingRecord
from skyproof.scenes.splits import SPLITS
from skyproof.words import counted, named

_MANY_MORE = 3
"""A detector that finds this many times the labelled vehicles mostly raises false alarms."""

_LARGE_SHARE = 0.10
_NOTES_SHOWN = 12
_FEW_TILES = 12
"""Fewest test tiles: with 12, a success rate has an interval of about ±30 points."""


def cleared_words(record: dict[str, Any], out: Path, *, checked: bool) -> Iterator[str]:
    """Yields counts, hints at mistakes, and the sheet to inspect, from the record of a clearing."""
    totals = record["totals"]
    reasons = (f"{count} because {why}" for why, count in totals["left_out"].items())
    left_out = ", ".join(reasons) or "none"
    yield f"Tiles: {totals['kept']} of {totals['tiles']} kept; left out: {left_out}."
    yield from emptied_words(totals["splits_without_tiles"])
    removed = totals["labelled_removed"] + totals["detected_removed"]
    yield (
        f"Vehicles removed: {removed}; {totals['masked_share']:.1%} of the ground filled; the "
        f"places of {totals['places']} are kept for skyproof render --settings.places removed."
    )
    for sentence in warnings(totals, record["vehicles_from"]):
        yield f"WARNING: {sentence}"
    yield from light_words(record)
    if not checked:
        yield "Not checked by a detector: a person has to look at every tile."
    sheet = (out / "sheets" / "index.html").resolve()
    yield f"Look at {sheet}; take tiles out with skyproof clear {out} --reject TILE."


def emptied_words(splits: Sequence[str]) -> Iterator[str]:
    """Names the splits that have no tile any more."""
    remedy = "give more imagery before using this folder for it"
    yield from (f"No tile of the split {split} is left; {remedy}." for split in splits)


def light_words(record: dict[str, Any]) -> Iterator[str]:
    """Counts the sources whose sun is known, overcast or unknown."""
    suns, overcast, photographs = record["suns"], record["overcast"], record["photographs"]
    sunny = [sun for name, sun in suns.items() if name not in overcast]
    if sunny:
        elevations_deg = [math.degrees(sun["elevation_rad"]) for sun in sunny]
        yield (
            f"Sun known over {len(sunny)} of {photographs} sources, {min(elevations_deg):.0f} to "
            f"{max(elevations_deg):.0f} degrees high: vehicles will stand in it."
        )
    if overcast:
        yield (
            f"Overcast: over {len(overcast)} of {photographs} sources the shadows of vehicles end "
            "softly, so vehicles will be drawn in the sky's light alone."
        )
    unknown = photographs - len(sunny) - len(overcast)
    if unknown:
        yield (
            f"Where the sun stood over {unknown} of {photographs} sources is not known (too few "
            "vehicles with clear shadows on even ground): scenes will draw any sun."
        )


def warnings(totals: dict[str, Any], vehicles_from: list[str]) -> Iterator[str]:
    """Yields a sentence on each sign that plain ground was taken for vehicles and filled."""
    labelled, detected = totals["labelled_removed"], totals["detected_removed"]
    if "labels" in vehicles_from and detected > _MANY_MORE * max(labelled, 1):
        yield (
            f"{detected} removed vehicles were only found by the detector, and {labelled} are "
            "labelled: most of what it finds here may be no vehicle; look at the sheet, and take "
            "another detector or a higher threshold (skyproof precheck --freeze)."
        )
    if totals["masked_share"] > _LARGE_SHARE:
        yield (
            f"{totals['masked_share']:.0%} of the ground was filled, more than the "
            f"{_LARGE_SHARE:.0%} of a place with many vehicles: detectors will be tested on "
            "painted-over ground; look at the sheet, and take another detector or a higher "
            "threshold (skyproof precheck --freeze)."
        )


def tiling_words(
    record: TilingRecord, *, labelled: bool, told: Collection[str] = ()
) -> Iterator[str]:
    """Yields notes, counts of tiles, and a warning if they are too few for a test.

    Notes that were `told` before are left out.
    """
    new = [note for note in record.notes if note not in told]
    yield from (f"  note: {note}" for note in merged_notes(new))
    for split in SPLITS:
        count = record.counts[split]
        what = {"tiles": "tile"}
        if labelled:
            what |= {"vehicles": "vehicle", "ignored": "ignore region"}
        counts = ", ".join(counted(count[key], noun) for key, noun in what.items())
        yield f"  {split:<10} {counts}"
    few = record.counts["test"]["tiles"]
    if 0 < few < _FEW_TILES:
        yield (
            f"  {counted(few, 'test tile')}: too few for a useful interval. If the vehicles of a "
            "tile succeed or fail together, a success rate is uncertain by "
            f"±{100 / math.sqrt(few):.0f} points; give more imagery, or make the tiles smaller "
            "(--tiling.size-px of skyproof ground)."
        )
    if record.empty:
        yield f"  {counted(record.empty, 'cell')} left out: more than 2 % of each is empty"


def merged_notes(notes: Sequence[str]) -> list[str]:
    """Returns the first few notes, equal ones on several images as one; tiling.json holds all."""
    images: dict[str, list[str]] = {}
    for note in notes:
        if isinstance(note, ImageNote):
            images.setdefault(note.told, []).append(note.image)
        else:
            images.setdefault(note, [])
    merged = [
        f"{named(names, 'image')}: {told}" if names else told for told, names in images.items()
    ]
    rest = len(merged) - _NOTES_SHOWN
    more = [f"{rest} more in tiling.json, once tiled"] if rest > 0 else []
    return merged[:_NOTES_SHOWN] + more
