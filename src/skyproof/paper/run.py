"""What a finished reproduction holds: rates, curves and records of every camouflage, read from its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from skyproof.camouflage.names import pooled_name
from skyproof.errors import StoredFileError
from skyproof.files import read_json
from skyproof.paper.curves import Curve, curve_families, practicality_curve
from skyproof.results.merge import merge_evaluations
from skyproof.results.pairs.tiles import Series, TileCounts
from skyproof.results.statistics.intervals import Interval, cluster_interval, resample
from skyproof.results.statistics.rates import overall_attack_success_rate, success_difference
from skyproof.results.summary import MEAN, summarise

__all__ = ["CYCLES", "MATCH", "RENDERER", "Reproduction", "point_name", "read_reproduction"]

MATCH = "centre_1m"
# As they are called in the scores: the renderer that attacks go through, and the second opinion.
RENDERER = "torch"
CYCLES = "cycles"


@dataclass(frozen=True)
class Reproduction:
    """A reproduction, read.

    Attributes:
        folder: of the run.
        rows: of `results.json`, both match rules; those on Cycles, where there are any, last.
        tiles: counts that the rows come from.
        records: per attack (with its repeat) what `camouflage.json` records.
        measures: per camouflage (without its repeat) its measured practicality; empty where not measured.
        config, environment: of the run; empty where missing.
        hours: that all finished jobs took together; None where not known.
    """

    folder: Path
    rows: list[dict[str, Any]]
    tiles: TileCounts
    records: Mapping[str, Mapping[str, Any]]
    measures: Mapping[str, Mapping[str, Any]]
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    hours: float | None

    @cached_property
    def detectors(self) -> list[str]:
        """In the order of the results."""
        return list(dict.fromkeys(row["detector"] for row in self.rows if row["detector"] != MEAN))

    @cached_property
    def cycles(self) -> bool:
        """Whether anything was scored on Cycles."""
        return any(row["renderer"] == CYCLES for row in self.rows)

    @cached_property
    def _by_name(self) -> dict[tuple[str, str, str], dict[str, Any]]:
        rows = [row for row in self.rows if row["match"] == MATCH]
        return {(row["camouflage"], row["detector"], row["renderer"]): row for row in rows}

    def row(
        self, name: str, detector: str | None = None, *, renderer: str = RENDERER
    ) -> dict[str, Any] | None:
        """The row of a camouflage, of the mean over detectors or of one detector; None where it was not scored."""
        wanted = detector or (MEAN if len(self.detectors) > 1 else self.detectors[0])
        return self._by_name.get((name, wanted, renderer))

    def corrected_p(self, name: str) -> float | None:
        """The largest Holm-corrected McNemar p over the detectors (PAPER 40); None where one was not tested."""
        found = [
            (self.row(name, detector) or {}).get("mcnemar_p_holm") for detector in self.detectors
        ]
        return None if any(p is None for p in found) else max(p for p in found if p is not None)

    @cached_property
    def names(self) -> list[str]:
        """Of all camouflages, without repeats."""
        return list(dict.fromkeys(row["camouflage"] for row in self.rows))

    @cached_property
    def curves(self) -> dict[str, Curve]:
        """Per attack with a shape ("S-O", "C-Fc-seq") its EASR against practicality (PAPER 52)."""
        return {
            family: practicality_curve(
                self.tiles, family, generator=np.random.default_rng(0), match=MATCH
            )
            # S-O first, as in the paper.
            for family in sorted(curve_families(self.tiles), key=lambda family: family != "S-O")
        }

    @cached_property
    def best(self) -> dict[str, str]:
        """Per attack with a shape, the name of what stands at its PM*."""
        return {family: point_name(family, curve.best) for family, curve in self.curves.items()}

    def one(self, camouflage: str) -> float | None:
        """EASR of one single camouflage with its repeat, mean over detectors; None where unknown or undefined."""
        counts = self._counts(camouflage)
        if counts is None:
            return None
        value = float(overall_attack_success_rate(counts.sum(axis=1)).mean())
        return None if np.isnan(value) else value

    def difference(self, later: str, earlier: str) -> Interval | None:
        """EASR of one single camouflage minus another's, on the same resampled tiles; None where one is unknown."""
        after, before = self._counts(later), self._counts(earlier)
        if after is None or before is None:
            return None
        return cluster_interval(
            np.concatenate([after, before]), success_difference(len(after)), self.weights
        )

    def _counts(self, camouflage: str) -> np.ndarray | None:
        keys = [Series(camouflage, RENDERER, detector, MATCH) for detector in self.detectors]
        found = [self.tiles.series[key][:, 1:] for key in keys if key in self.tiles.series]
        return np.stack(found) if len(found) == len(keys) else None

    @cached_property
    def weights(self) -> np.ndarray:
        """Resampled tiles, `[R, C]`, for whatever is not in the rows."""
        return resample(len(self.tiles.tiles), generator=np.random.default_rng(0))


def point_name(family: str, magnitude: float) -> str:
    """What stands at one point of a curve; at magnitude 0 the texture ("S-O@0" of S-O, which is never scored)."""
    if magnitude > 0 or family == "S-O":
        return f"{family}@{magnitude:g}"
    return "T-" + family.split("-")[1]


def read_reproduction(folder: Path) -> Reproduction:
    """Reads a run folder of `skyproof reproduce`.

    Raises:
        StoredFileError: nothing was scored yet, or a file is damaged.
        ConfigurationError: the scores do not belong together.
    """
    folder = Path(folder)
    scores, on_cycles = (
        sorted(path for path in (folder / name).glob("*") if not path.name.startswith("."))
        for name in ("scores", "scores-cycles")
    )
    if not scores:
        raise StoredFileError(
            f"{folder} holds no scores; run skyproof reproduce, or give its run folder."
        )
    tiles, sets = merge_evaluations([*scores, *on_cycles])
    config = _read(folder / "config.json")
    rows = []
    for renderer in dict.fromkeys(key.renderer for key in tiles.series):
        # One by one, Holm's correction too: the renderer's numbers stay as they are when Cycles is added.
        own = TileCounts(
            tiles.tiles,
            {key: counts for key, counts in tiles.series.items() if key.renderer == renderer},
        )
        rows += summarise(own, sets, generator=np.random.default_rng(config.get("seed", 0)))
    records = {
        path.parent.name: read_json(path).get("record", {})
        for path in sorted((folder / "camouflages").glob("*/camouflage.json"))
    }
    measured = _read(folder / "measures.json").get("rows", [])
    return Reproduction(
        folder=folder,
        rows=rows,
        tiles=tiles,
        records=records,
        measures={pooled_name(row["name"]): row for row in measured},
        config=config,
        environment=_read(folder / "environment.json"),
        hours=_hours(folder),
    )


def _read(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    value = read_json(path)
    if not isinstance(value, dict):
        raise StoredFileError(
            f"{path} is not of the form that this version writes; run its stage again."
        )
    return value


def _hours(folder: Path) -> float | None:
    """From the benchmark files that the workflow leaves, one per finished job."""
    seconds = []
    for path in (folder / "benchmarks").glob("*/*.tsv"):
        with suppress(ValueError, IndexError):
            seconds.append(float(path.read_text(encoding="utf-8").splitlines()[1].split("\t")[0]))
    return sum(seconds) / 3600 if seconds else None
