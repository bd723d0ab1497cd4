"""Groups photographs that were taken on one flight, and so share their light."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

from skyproof.imagery.tiles.sources import Source
from skyproof.scenes.background_index import BackgroundTile

LONGEST_PAUSE = timedelta(hours=1)
"""The sun turns by 15 degrees an hour, as much as its estimates are off."""


def flights_of(sources: Sequence[Source]) -> list[str]:
    """Names the flight of each source by its first photograph.

    A flight's photographs have one folder and one reference system, and their names differ only in
    the last number. None was taken over an hour after the one before, as far as times are stated.
    """
    series: dict[tuple[Path, str, str], list[Source]] = defaultdict(list)
    for one in sources:
        stem = re.sub(r"\d+$", "", one.path.stem)
        series[one.path.resolve().parent, str(one.georeference.crs), stem].append(one)
    flights: dict[Path, str] = {}
    for alike in series.values():
        name, before = alike[0].path.name, None
        for one in sorted(alike, key=lambda each: each.exif.taken or datetime.min):
            taken = one.exif.taken
            if before is not None and taken is not None and taken - before > LONGEST_PAUSE:
                name = one.path.name
            before = taken or before
            flights[one.path] = name
    return [flights[one.path] for one in sources]


def by_flight(tiles: Iterable[BackgroundTile]) -> list[list[BackgroundTile]]:
    """Groups the tiles of imagery by their flight, or else source; drawn tiles are skipped."""
    groups: dict[str, list[BackgroundTile]] = defaultdict(list)
    for tile in tiles:
        if tile.kind is None:
            groups[tile.flight or tile.source].append(tile)
    return [*groups.values()]
