"""Says whether the answer depends on the fleet: success rates on two fleets, and their difference.

    python tools/fleet_answers.py --drawn RUN/scores/drawn --learnt RUN/scores/learnt \\
        --out RUN/answers.json

Both are score folders of the same camouflages, by the same detectors, on the same tiles; only the
vehicles that wear them are of other fleets. Tiles and repeats are paired, vehicles are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from skyproof.camouflage.name import CamouflageName
from skyproof.files import new_file, write_json
from skyproof.results.pairs.tiles import Cell, TileCounts, read_tiles
from skyproof.results.repeats import repeat_of
from skyproof.results.rows import MAIN_MATCH
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import Interval
from skyproof.results.statistics.sample import Sample


@dataclass(frozen=True)
class FleetAnswers:
    """Compares two fleets.

    Attributes:
        drawn, learnt: score folders.
        out: JSON file to write.
    """

    drawn: Path
    learnt: Path
    out: Path

    def run(self) -> dict[str, Any]:
        """Compares, prints, writes, and returns what the file holds."""
        with new_file(self.out):
            sides = {
                name: read_tiles(folder / "tiles.parquet")
                for name, folder in (("drawn", self.drawn), ("learnt", self.learnt))
            }
            record = compared(sides["drawn"], sides["learnt"])
            for name, row in record.items():
                print(name, row, flush=True)
            write_json(self.out, record)
        return record


def compared(drawn: TileCounts, learnt: TileCounts) -> dict[str, Any]:
    """Gives by camouflage the EASR on either fleet, mean over repeats and detectors, and how much
    more it is on the learnt one: estimate, low and high, as fractions.
    """
    cells: list[Cell] = [
        (tile, f"{fleet} {vehicle}")
        for fleet, tiles in (("drawn", drawn), ("learnt", learnt))
        for tile, vehicle in tiles.cells
    ]
    sample = Sample.draw(cells, generator=np.random.default_rng(0))
    before, after = len(drawn.cells), len(learnt.cells)
    groups = (_groups(drawn, 0, after), _groups(learnt, before, 0))
    record: dict[str, Any] = {}
    for name in groups[0]:
        if name in groups[1]:
            on_drawn, on_learnt = groups[0][name], groups[1][name]
            record[name] = {
                "drawn": _fractions(mean_interval(on_drawn, sample)),
                "learnt": _fractions(mean_interval(on_learnt, sample)),
                "more_on_learnt": _fractions(difference_interval([on_learnt], [on_drawn], sample)),
            }
    return record


def _groups(tiles: TileCounts, before: int, after: int) -> dict[str, Group]:
    """Gives the series of each camouflage, with empty cells where the other fleet's are."""
    pooled: dict[str, list[tuple[CamouflageName, np.ndarray]]] = {}
    for series, counts in tiles.series.items():
        if series.match == MAIN_MATCH:
            name = CamouflageName.parse(series.camouflage)
            padded = np.pad(counts[:, 1:], ((before, after), (0, 0)))
            pooled.setdefault(str(name.pooled), []).append((name, padded))
    return {
        name: Group(
            np.stack([counts for _, counts in own]),
            # What was chosen among many is one of a kind.
            [[] if each.choice else [repeat_of(str(each))] for each, _ in own],
        )
        for name, own in pooled.items()
    }


def _fractions(interval: Interval) -> list[float]:
    return [round(float(value), 4) for value in (interval.estimate, interval.low, interval.high)]


if __name__ == "__main__":
    tyro.cli(FleetAnswers).run()
