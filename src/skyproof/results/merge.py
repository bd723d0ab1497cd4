"""Several score folders as one: what many small jobs counted becomes one table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.results.pairs.counts import OutcomeCounts, Series, read_counts
from skyproof.results.pairs.outcomes import ORIGINAL
from skyproof.results.score_folder import ScoreFolder, SetScore


def merge_counts(folders: Sequence[Path]) -> tuple[OutcomeCounts, list[SetScore]]:
    """Reads the counts and set scores of several score folders that share scenes and detectors.

    What is in more than one folder (the set without camouflage always is) must be the same in all
    of them. Folders that only checked detectors have no counts and are passed over.

    Raises:
        ConfigurationError: one camouflage has different results; the folders show other scenes or
            judge with other detectors.
        StoredFileError: a file is missing or damaged.
    """
    compared = [folder for folder in folders if ScoreFolder.open(folder).record.renderer]
    read = [(folder, read_counts(folder / "outcomes.parquet")) for folder in compared]
    cells = sorted({cell for _, tiles in read for cell in tiles.cells})
    place = {cell: index for index, cell in enumerate(cells)}
    series: dict[Series, np.ndarray] = {}
    source: dict[Series, Path] = {}
    shown: dict[str, tuple[Path, np.ndarray]] = {}
    for folder, tiles in read:
        rows = [place[cell] for cell in tiles.cells]
        for key, counts in tiles.series.items():
            spread = np.zeros((len(cells), 4), dtype=np.int64)
            spread[rows] = counts
            if key in series and not np.array_equal(series[key], spread):
                raise _contradiction(
                    source[key], folder, f"{key.camouflage} as seen by {key.detector}"
                )
            first, vehicles = shown.setdefault(key.renderer, (folder, spread[:, 0]))
            if not np.array_equal(vehicles, spread[:, 0]):
                raise ConfigurationError(
                    f"{first} and {folder} do not show the same vehicles on the same tiles; "
                    "put only scores of one scene file into one run."
                )
            series.setdefault(key, spread)
            source.setdefault(key, folder)
    _refuse_other_judges(source)
    return OutcomeCounts(tuple(cells), series), _merge_sets([folder for folder, _ in read])


def _refuse_other_judges(source: Mapping[Series, Path]) -> None:
    """Keeps repeats of one camouflage together that the same detectors judged.

    Raises:
        ConfigurationError: some did not judge all; their rows would be left out in silence.
    """
    judges: dict[tuple[CamouflageName, str], dict[str, set[str]]] = {}
    for key in source:
        pooled = (CamouflageName.read(key.camouflage).pooled, key.renderer)
        judges.setdefault(pooled, {}).setdefault(key.camouflage, set()).add(key.detector)
    for repeats in judges.values():
        every = set().union(*repeats.values())
        for name, own in repeats.items():
            if own != every:
                place = next(path for key, path in source.items() if key.camouflage == name)
                raise ConfigurationError(
                    f"{place} has {name} judged by {', '.join(sorted(own))}, and another repeat of "
                    f"it is judged by {', '.join(sorted(every))}; score all repeats with the same "
                    "detectors, or leave the folder out."
                )


def _merge_sets(folders: Sequence[Path]) -> list[SetScore]:
    kept: dict[Series, tuple[Path, SetScore]] = {}
    for folder in folders:
        for score in ScoreFolder.open(folder).sets():
            key = Series(score.camouflage, score.renderer, score.detector, score.match)
            first, other = kept.setdefault(key, (folder, score))
            same = _same(score.average_precision, other.average_precision)
            if not same or not _same(score.false_alarms_per_km2, other.false_alarms_per_km2):
                what = (
                    "the images without camouflage"
                    if key.camouflage == ORIGINAL
                    else key.camouflage
                )
                raise _contradiction(first, folder, f"{what} as seen by {key.detector}")
    return [score for _, score in kept.values()]


def _same(one: float, other: float) -> bool:
    return (math.isnan(one) and math.isnan(other)) or math.isclose(
        one, other, rel_tol=1e-9, abs_tol=1e-12
    )


def _contradiction(first: Path, second: Path, what: str) -> ConfigurationError:
    return ConfigurationError(
        f"{first} and {second} hold different results for {what}; leave one of the folders out, "
        "or score both again with the same scenes and detectors."
    )
