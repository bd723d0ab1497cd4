"""What is said of imagery that was cut into tiles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from skyproof.imagery.tiles.tiling import TilingRecord
from skyproof.scenes.splits import SPLITS

_NOTES_SHOWN = 12
_FEW_TILES = 12
"""Of as many, a success rate that tiles decide has an interval of some ±30 points."""


def tiling_words(
    record: TilingRecord, *, labelled: bool, like: Path | None = None
) -> Iterator[str]:
    """Says what was cut, what was noted on the way, and whether it is enough for a test.

    Args:
        record: of `tile_imagery`.
        labelled: whether labels were given.
        like: the tiled folder whose ground was cut again, if any.
    """
    for note in record.notes[:_NOTES_SHOWN]:
        yield f"  note: {note}"
    if len(record.notes) > _NOTES_SHOWN:
        yield f"  note: {len(record.notes) - _NOTES_SHOWN} more in tiling.json"
    for split in SPLITS:
        count = record.counts[split]
        vehicles = ""
        if labelled:
            vehicles = f", {count['vehicles']} vehicles, {count['ignored']} ignore regions"
        yield f"  {split:<10} {count['tiles']:>7} tiles{vehicles}"
    few = record.counts["test"]["tiles"]
    if 0 < few < _FEW_TILES and like is None:
        yield (
            f"  {few} test tiles are too few for a useful interval: where what a tile's vehicles "
            f"have in common decides, a success rate stays open by ±{100 / math.sqrt(few):.0f} "
            "points; give more imagery, or make the tiles smaller (--tiling.size-px of skyproof "
            "ground)."
        )
    if like is not None:
        yield f"  {len(record.missing)} tiles of {like} are missing here (listed in tiling.json)"
    elif record.empty:
        yield f"  {record.empty} cells left out: more than 2 % of each is empty"
