"""Several score folders as one."""

import math
from collections.abc import Sequence

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.results.pairs.counts import OutcomeCounts, Series, read_counts
from skyproof.results.pairs.outcomes import ORIGINAL
from skyproof.results.score_folder import ScoreFolder, SetScore


def merge_scores(folders: Sequence[ScoreFolder]) -> tuple[OutcomeCounts, list[SetScore]]:
    """Reads the outcomes and set scores of several score folders that share scenes and detectors.

    The same result in several folders (the unchanged images always are) must be equal in all of
    them. Folders with baselines alone are passed over.

    Raises:
        ConfigurationError: folders contradict each other, or have other scenes or detectors.
        StoredFileError: a file is missing or damaged.
    """
    compared = [folder for folder in folders if folder.record.renderer]
    read = [(folder, read_counts(folder.path / "outcomes.parquet")) for folder in compared]
    cells = sorted({cell for _, counts in read for cell in counts.cells})
    place = {cell: index for index, cell in enumerate(cells)}
    series: dict[Series, np.ndarray] = {}
    source: dict[Series, ScoreFolder] = {}
    shown: dict[str, tuple[ScoreFolder, np.ndarray]] = {}
    for folder, counted in read:
        rows = [place[cell] for cell in counted.cells]
        for key, counts in counted.series.items():
            spread = np.zeros((len(cells), 4), dtype=np.int64)
            spread[rows] = counts
            if key in series and not np.array_equal(series[key], spread):
                raise _contradiction(source[key], folder, key)
            first, vehicles = shown.setdefault(key.renderer, (folder, spread[:, 0]))
            if not np.array_equal(vehicles, spread[:, 0]):
                raise ConfigurationError(
                    f"{first.path} and {folder.path} do not show the same vehicles on the same "
                    "tiles; put only scores of one scene file into one run."
                )
            series.setdefault(key, spread)
            source.setdefault(key, folder)
    _refuse_other_detectors(source)
    return OutcomeCounts(tuple(cells), series), _merge_sets(compared)


def _refuse_other_detectors(source: dict[Series, ScoreFolder]) -> None:
    """Refuses repeats of one camouflage with other detectors: they would be left out in silence."""
    scored: dict[tuple[CamouflageName, str], dict[str, set[str]]] = {}
    for key in source:
        pooled = (CamouflageName.read(key.camouflage).pooled, key.renderer)
        scored.setdefault(pooled, {}).setdefault(key.camouflage, set()).add(key.detector)
    for repeats in scored.values():
        every = set().union(*repeats.values())
        for name, own in repeats.items():
            if own != every:
                place = next(score.path for key, score in source.items() if key.camouflage == name)
                raise ConfigurationError(
                    f"{place} has {name} scored with {', '.join(sorted(own))}, and another repeat "
                    f"of it is scored with {', '.join(sorted(every))}; score all repeats with the "
                    "same detectors, or leave the folder out."
                )


def _merge_sets(folders: Sequence[ScoreFolder]) -> list[SetScore]:
    kept: dict[Series, tuple[ScoreFolder, SetScore]] = {}
    for folder in folders:
        for score in folder.sets():
            key = Series(score.camouflage, score.renderer, score.detector, score.match)
            first, other = kept.setdefault(key, (folder, score))
            same = _same(score.average_precision, other.average_precision)
            if not same or not _same(score.false_alarms_per_km2, other.false_alarms_per_km2):
                raise _contradiction(first, folder, key)
    return [score for _, score in kept.values()]


def _same(one: float, other: float) -> bool:
    return (math.isnan(one) and math.isnan(other)) or math.isclose(
        one, other, rel_tol=1e-9, abs_tol=1e-12
    )


def _contradiction(first: ScoreFolder, second: ScoreFolder, key: Series) -> ConfigurationError:
    unchanged = key.camouflage == ORIGINAL
    what = "the images without camouflage" if unchanged else key.camouflage
    return ConfigurationError(
        f"{first.path} and {second.path} hold different results for {what} and {key.detector}; "
        "leave one of the folders out, or score both again with the same scenes and detectors."
    )
