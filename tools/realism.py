"""Measures how well rendered vehicles are told from real ones, and by what.

    python tools/realism.py --real 'Town=RUN/tiles/test@0.125' --rendered Town=RUN/rendered \\
        --backgrounds RUN/tiles --out RUN/realism

RUN/tiles is labelled imagery cut by `skyproof ground`, RUN/rendered what `skyproof render` drew on
the same tiles after `skyproof clear`, in images as large as the tiles, so that both show their
pixels unchanged (docs/results/reality/README.md).

A small network learns to tell windows around rendered vehicles from those around real ones, on
other ground and other vehicles than it is tested on; so it does on windows that show the vehicle
alone, or all but the vehicle. The area under its ROC curve is 0.5 where it sees no difference and 1
where it is always right. Two nulls beside it have to be near 0.5: real vehicles against other real
ones, which is above where vehicles leak from training into test; and ground without vehicles of
real against rendered images, which is above where resampling or filling tells them apart.

OUT gets realism.json, pairs.png (real above, rendered below), told.png and occlusion.png. The
pictures show the imagery: they are for looking at, not for a repository.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from realism_crops import Crop, read_crops
from realism_folds import spots
from realism_sheets import pairs, write_pairs, write_told
from realism_statistics import compare, statistics
from realism_trials import (
    Effort,
    Row,
    hide_parts,
    make_trials,
    null_of_real,
    rounded_area,
    row_of,
    tell,
)

from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder, write_json

_PAIRS = 70


@dataclass(frozen=True)
class Realism:
    """Tells rendered vehicles from real ones.

    Attributes:
        real: labelled imagery, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD as `skyproof check --frames`
            takes it; arguments of one NAME are one place.
        rendered: datasets as NAME=FOLDER, with the NAME of the place that they stand on.
        out: folder to write.
        backgrounds: tiled folders that say where the tiles of both lie.
        classes: of the real labels, those that count as vehicles.
        crops: of each kind of window at most so many.
        folds: strips that every place is cut into.
        seeds: how often each network is trained.
        steps: of each training.
        seed: decides every draw.
    """

    real: tuple[str, ...]
    rendered: tuple[str, ...]
    out: Path
    backgrounds: tuple[Path, ...] = ()
    classes: tuple[str, ...] = ("vehicle",)
    crops: int = 500
    folds: int = 3
    seeds: int = 3
    steps: int = 100
    seed: int = 0

    def run(self) -> Row:
        """Measures, prints, writes, and returns what realism.json holds."""
        started = time.process_time()
        with finished_folder(self.out) as folder:
            crops, gsd_m = read_crops(
                self.real,
                self.rendered,
                self.backgrounds,
                self.classes,
                most=self.crops,
                generator=np.random.default_rng(self.seed),
            )
            vehicles = crops.vehicles
            counts = _counts(vehicles, crops.empty)
            print(f"{counts}; {crops.left_out} vehicles left out: at the border of their image")

            # What networks can tell.
            seeds = tuple(range(self.seed, self.seed + self.seeds))
            effort = Effort(gsd_m, self.folds, self.steps, seeds)
            rows = []
            told = []
            for trial in make_trials(vehicles, crops.empty, self.folds):
                told.append(tell(trial, effort))
                rows.append(row_of(trial, told[-1], self.seed))
                print(_line(rows[-1]), flush=True)
            rows.append(null_of_real(vehicles, effort))
            print(_line(rows[-1]), flush=True)

            # What a person can see.
            whole = told[0]
            write_told(folder / "told.png", vehicles, whole.scores.mean(0))
            falls = hide_parts(vehicles, whole, gsd_m, self.seed, folder / "occlusion.png")
            print(f"By how much hiding 1.25 m lowers the logit of the truth: {falls}")
            chosen, matched = pairs(vehicles, _PAIRS, np.random.default_rng(self.seed))
            write_pairs(folder / "pairs.png", vehicles, chosen)
            values = self._statistics(vehicles, gsd_m)
            print(_table(values))
            settings = asdict(self)
            settings["out"] = str(self.out)
            settings["backgrounds"] = [str(path) for path in self.backgrounds]
            record = {
                "settings": settings,
                "gsd_m": gsd_m,
                "windows": counts,
                "left_out": crops.left_out,
                "rows": rows,
                "occlusion": falls,
                "pairs": {"shown": len(chosen), "of_one_spot": matched},
                "statistics": values,
                "cpu_s": round(time.process_time() - started, 1),
            }
            write_json(folder / "realism.json", record)
        print(f"{self.out}, {record['cpu_s']} CPU-seconds")
        return record

    def _statistics(self, vehicles: Sequence[Crop], gsd_m: float) -> Row:
        rendered = np.array([crop.rendered for crop in vehicles])
        spot_of = spots(vehicles)
        one_fold = np.zeros(len(vehicles), dtype=np.int64)
        return compare(
            statistics(vehicles, gsd_m),
            rendered,
            spot_of,
            lambda own: rounded_area(own[None], rendered, one_fold, spot_of, self.seed),
        )


def _counts(vehicles: Sequence[Crop], empty: Sequence[Crop]) -> dict[str, dict[str, int]]:
    counts = {}
    for kind, wanted in (("real", False), ("rendered", True)):
        own = [crop for crop in vehicles if crop.rendered == wanted]
        if not own:
            raise ConfigurationError(
                f"Expected {kind} vehicles, got none that the border of its image does not cut; "
                "give more or larger images."
            )
        counts[kind] = {
            "vehicles": len(own),
            "spots": len(np.unique(spots(own))),
            "alone": sum(crop.alone for crop in own),
            "without a vehicle": sum(crop.rendered == wanted for crop in empty),
        }
    return counts


def _cell(area: dict[str, Any]) -> str:
    if "low" not in area:
        return f"{area['auc']:.3f}" if "auc" in area else "–"
    return f"{area['auc']:.3f} ({area['low']:.3f}–{area['high']:.3f})"


def _line(row: Row) -> str:
    seeds = " ".join(f"{value:.3f}" for value in row["by_seed"])
    parts = [f"{row['name']:<30} AUC {_cell(row)}", f"seeds {seeds}"]
    if "null" not in row["name"]:
        parts.append(f"standing alone {_cell(row['alone'])}")
        parts += [f"{name} {_cell(area)}" for name, area in row["by_place"].items()]
    if "tested" in row:
        parts.append(f"tested {row['tested'][0]} and {row['tested'][1]}")
    return "; ".join(parts)


def _table(values: dict[str, dict[str, Any]]) -> str:
    lines = [f"{'':<34}{'real: p10, p50, p90':>28}{'rendered':>28}   AUC of it alone"]
    for name, row in values.items():
        columns = ["".join(f"{value:9.2f}" for value in row[kind]) for kind in ("real", "rendered")]
        lines.append(f"{name:<34}{columns[0]:>28}{columns[1]:>28}   {_cell(row['auc'])}")
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(Realism).run()
