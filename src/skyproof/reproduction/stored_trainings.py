"""Several trainings of the same detectors, each with attacks of its own, on the same vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from skyproof.errors import ConfigurationError
from skyproof.layout import Layout
from skyproof.results.merge import merge_counts
from skyproof.results.pairs.tiles import Cell, TileCounts
from skyproof.results.score_folder import ScoreFolder
from skyproof.results.stored import DetectorFacts, read_detectors

_REMEDY = "put only trainings of one recipe on the same images into one run"


@dataclass(frozen=True)
class Training:
    """Detectors of one training, and what the attacks on them came to.

    Attributes:
        number: 0 of the run's own, of which all its other results are; else the folder's in
            `trainings/`.
        tiles: counts of what was scored by them.
        detectors: by name, what is recorded of them.
    """

    number: int
    tiles: TileCounts
    detectors: Mapping[str, DetectorFacts]


def read_trainings(run_folder: Path, own: Training) -> list[Training]:
    """Gives the run's own training and, after it, the further ones that were scored.

    Raises:
        ConfigurationError: two trainings differ in data, recipe or test vehicles, or are the same.
        StoredFileError: a file is damaged.
    """
    layout = Layout(run_folder)
    names = [path.name for path in layout.trainings.glob("*") if path.name.isdecimal()]
    trainings = [own]
    for number in sorted(int(name) for name in names if name == str(int(name)) and int(name)):
        place = layout.training(number)
        # What is hidden is being made, or a kill left it.
        if not any(path.is_dir() for path in place.scores.glob("[!.]*")):
            continue
        tiles, _ = merge_counts([score.path for score in ScoreFolder.all_of(place.folder)])
        trainings.append(Training(number, tiles, read_detectors(place.detectors)))
    for training in trainings[1:]:
        _refuse_other_vehicles(own, training)
    for later, training in enumerate(trainings):
        for earlier in trainings[:later]:
            _refuse_other_data(earlier, training)
    return trainings


def _refuse_other_vehicles(own: Training, training: Training) -> None:
    if _in_sight(own.tiles) != _in_sight(training.tiles):
        raise ConfigurationError(
            f"Training {training.number} was not scored on the vehicles and tiles of training "
            f"{own.number}; score both on the same scenes."
        )
    judges = [sorted({key.detector for key in each.tiles.series}) for each in (own, training)]
    if judges[0] != judges[1]:
        raise ConfigurationError(
            f"Training {training.number} was scored by {', '.join(judges[1])}, but training "
            f"{own.number} by {', '.join(judges[0])}; train and score every detector as often."
        )


def _refuse_other_data(earlier: Training, training: Training) -> None:
    """Trainings of other data or another recipe would differ by more than chance."""
    for name, facts in training.detectors.items():
        before = earlier.detectors.get(name)
        if before is None:
            continue
        which = f"Trainings {earlier.number} and {training.number} of {name}"
        known = _learnt_from(before)
        for what, value in _learnt_from(facts).items():
            if known[what] != value:
                raise ConfigurationError(
                    f"{which} differ in their {what} ({_short(known[what])} and {_short(value)}), "
                    f"so that they do not show what chance alone does; {_REMEDY}."
                )
        if facts.weights_sha256 and facts.weights_sha256 == before.weights_sha256:
            raise ConfigurationError(
                f"{which} have the same weights, and so are one training; train again from "
                "another seed, or leave one out."
            )


def _learnt_from(facts: DetectorFacts) -> dict[str, Any]:
    recipe = facts.training
    return {
        "number of training images": recipe.images,
        "training images": recipe.data_sha256,
        "validation images": recipe.validation_sha256,
        "origin of the training images": facts.trained_on,
        "size": facts.size,
        "settings": recipe.identity.settings,
    }


def _short(value: Any) -> str:
    text = "unknown" if value in ("", None) else str(value)
    return text[:12] if len(text) == 64 else text[:300]


def _in_sight(tiles: TileCounts) -> dict[Cell, int]:
    """How many vehicles stand in each cell, the same for all series."""
    shown: Sequence[Int[np.ndarray, "N 4"]] = list(tiles.series.values())
    counts = np.max([each[:, 0] for each in shown], axis=0).tolist() if shown else []
    return {cell: count for cell, count in zip(tiles.cells, counts, strict=True) if count}
