"""What is told from what, by which network, and how well, for tools/realism.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realism_classifier import Network, View, Windows, judge, learn, occlusion
from realism_crops import CROP_M, Crop, side_px
from realism_folds import Fold, auc_interval, place_folds, spots, strip_folds
from realism_sheets import write_occlusion
from scipy import stats

from skyproof.errors import ConfigurationError

VIEWS: tuple[View, ...] = ("whole", "vehicle", "ground")
NULL_REAL = "null: real from other real"
NULL_GROUND = "null: ground without vehicles"

_GAP_M = CROP_M + 1.0  # windows of training and test then share no pixel
_FEWEST = 5  # windows of a kind that a network can learn from, or an AUC be of
_OCCLUDED = 60
_PATCH_M, _STRIDE_M = 1.25, 0.5

Row = dict[str, Any]


@dataclass(frozen=True)
class Effort:
    """How much is trained.

    Attributes:
        gsd_m: metres per pixel of all windows.
        folds: strips that every place is cut into.
        steps: of each training.
        seeds: one training each.
    """

    gsd_m: float
    folds: int
    steps: int
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Trial:
    """One thing to be told.

    Attributes:
        name: of it.
        crops: the windows.
        positive: `[N]` which of them count as rendered.
        folds: what is learnt from and tested.
        view: what is shown of each window.
    """

    name: str
    crops: Sequence[Crop]
    positive: NDArray[np.bool_]
    folds: Sequence[Fold]
    view: View = "whole"


@dataclass(frozen=True)
class Told:
    """What networks made of a trial.

    Attributes:
        scores: `[K, N]` per seed each window's logit; nan where it was not tested.
        fold_of: `[N]` in which fold it was; -1 where in none.
        networks: of the first seed, one per fold.
    """

    scores: NDArray[np.float64]
    fold_of: NDArray[np.int64]
    networks: Sequence[Network]


def make_trials(vehicles: Sequence[Crop], empty: Sequence[Crop], folds: int) -> list[Trial]:
    """Returns the trials of real against rendered windows; the first is of whole ones by strips.

    Args:
        vehicles: windows around vehicles.
        empty: windows of ground without vehicles, for the null; may be none.
        folds: strips that every place is cut into.
    """
    rendered = _rendered(vehicles)
    strips = strip_folds(vehicles, folds, _GAP_M)
    trials = [Trial(view, vehicles, rendered, strips, view) for view in VIEWS]
    across = place_folds(vehicles)
    if across:
        trials += [
            Trial(f"{view}, other place", vehicles, rendered, across, view) for view in VIEWS
        ]
    if empty:
        strips = strip_folds(empty, folds, _GAP_M)
        trials.append(Trial(NULL_GROUND, empty, _rendered(empty), strips))
    return trials


def tell(trial: Trial, effort: Effort) -> Told:
    """Trains a network per fold and seed and lets it judge what it has not seen.

    Raises:
        ConfigurationError: a fold has too few windows.
    """
    windows = Windows(trial.crops, side_px(effort.gsd_m)[1], effort.gsd_m)
    scores = np.full((len(effort.seeds), len(trial.crops)), np.nan)
    fold_of = np.full(len(trial.crops), -1)
    networks = []
    for number, fold in enumerate(trial.folds):
        for part in (fold.train, fold.test):
            kinds = np.bincount(trial.positive[part].astype(int), minlength=2)
            if kinds.min() < _FEWEST:
                raise ConfigurationError(
                    f"{trial.name}, {fold.name}: expected {_FEWEST} or more windows of each kind "
                    f"to learn from and to test, got {kinds.min()}; give more images, a larger "
                    "fleet or fewer --folds."
                )
        tested = np.flatnonzero(fold.test)
        fold_of[tested] = number
        for repeat, seed in enumerate(effort.seeds):
            network = learn(
                windows, trial.positive, fold, trial.view, steps=effort.steps, seed=seed
            )
            scores[repeat, tested] = judge(network, windows, tested, trial.view, seed=seed)
            if repeat == 0:
                networks.append(network)
    return Told(scores, fold_of, networks)


def row_of(trial: Trial, told: Told, seed: int) -> Row:
    """Says how well a trial was told: over all, per seed, of vehicles that stand alone, per place.

    Args:
        trial: what was told.
        told: what came out.
        seed: of the bootstrap.
    """
    places = np.array([crop.place for crop in trial.crops])
    alone = np.array([crop.alone for crop in trial.crops])
    spot_of = spots(trial.crops)

    def area(scores: NDArray[np.float64], chosen: NDArray[np.bool_]) -> dict[str, float]:
        fold_of = np.where(chosen, told.fold_of, -1)
        return rounded_area(scores, trial.positive, fold_of, spot_of, seed)

    everywhere = np.ones(len(trial.crops), dtype=bool)
    by_place = {str(place): area(told.scores, places == place) for place in np.unique(places)}
    sides = (False, True)
    return {
        "name": trial.name,
        **area(told.scores, everywhere),
        "by_seed": [area(scores[None], everywhere)["auc"] for scores in told.scores],
        "alone": area(told.scores, alone),
        "by_place": by_place if len(by_place) > 1 else {},
        "tested": [int((told.fold_of[trial.positive == side] >= 0).sum()) for side in sides],
        "learnt_from": [
            [int((fold.train & (trial.positive == side)).sum()) for side in sides]
            for fold in trial.folds
        ],
    }


def null_of_real(vehicles: Sequence[Crop], effort: Effort) -> Row:
    """Tells real vehicles from other real ones; the sides are drawn anew for every seed.

    Every spot is on one side as a whole, so whoever knows a vehicle again knows its side. The
    interval is Student's over the draws.
    """
    real = [crop for crop in vehicles if not crop.rendered]
    folds = strip_folds(real, effort.folds, _GAP_M)
    spot_of = spots(real)
    areas = []
    for seed in effort.seeds:
        side = np.random.default_rng(seed).permutation(spot_of.max() + 1) % 2 == 1
        trial = Trial(NULL_REAL, real, side[spot_of], folds)
        told = tell(trial, replace(effort, seeds=(seed,)))
        areas.append(rounded_area(told.scores, trial.positive, told.fold_of, spot_of, seed)["auc"])
    row: Row = {"name": NULL_REAL, "auc": round(float(np.mean(areas)), 4), "by_seed": areas}
    if len(areas) > 1:
        error = np.std(areas, ddof=1) / np.sqrt(len(areas))
        margin = float(stats.t.ppf(0.975, len(areas) - 1) * error)
        row |= {"low": round(row["auc"] - margin, 4), "high": round(row["auc"] + margin, 4)}
    return row


def rounded_area(
    scores: NDArray[np.float64],
    positive: NDArray[np.bool_],
    fold_of: NDArray[np.int64],
    spot_of: NDArray[np.int64],
    seed: int,
) -> dict[str, float]:
    """Returns `auc`, `low` and `high`, as far as they are defined; arguments as `auc_interval`."""
    generator = np.random.default_rng(seed)
    interval = auc_interval(scores, positive, fold_of, spot_of, generator=generator)
    values = {"auc": interval.estimate, "low": interval.low, "high": interval.high}
    return {name: round(value, 4) for name, value in values.items() if not np.isnan(value)}


def hide_parts(
    vehicles: Sequence[Crop], told: Told, gsd_m: float, seed: int, path: Path
) -> dict[str, dict[str, float]]:
    """Hides parts of windows from the networks and draws what that changes.

    Windows whose box is higher than wide are turned by a quarter before, so that vehicles of like
    heading lie alike.

    Args:
        vehicles: the windows.
        told: of whole windows.
        gsd_m: metres per pixel.
        seed: draws some windows of each kind.
        path: of the picture.

    Returns:
        Per kind of window how much less sure of the truth the networks are (logit), on average over
        patches in the middle and over those at the rim.
    """
    side, room = side_px(gsd_m)
    patch = round(_PATCH_M / gsd_m)
    stride = round(_STRIDE_M / gsd_m)
    pictures = {}
    maps = {}
    numbers = {}
    for kind, wanted in (("real", False), ("rendered", True)):
        tested = np.flatnonzero((_rendered(vehicles) == wanted) & (told.fold_of >= 0))
        chosen = np.random.default_rng(seed).permutation(tested)[:_OCCLUDED]
        windows = Windows([_lying(vehicles[index]) for index in chosen], room, gsd_m)
        falls = []
        for number, network in enumerate(told.networks):
            own = np.flatnonzero(told.fold_of[chosen] == number)
            if len(own):
                falls.append(occlusion(network, windows, own, patch, stride))
        mean = np.concatenate(falls).mean(0) * (1 if wanted else -1)
        pictures[kind] = windows.pixels[:, :, room : room + side, room : room + side]
        maps[kind] = mean
        steps = (np.arange(len(mean)) * stride + patch / 2 - side / 2) * gsd_m
        radius_m = np.hypot(steps[:, None], steps[None])
        numbers[kind] = {
            "within 1.2 m": round(float(mean[radius_m <= 1.2].mean()), 3),
            "beyond 2.4 m": round(float(mean[radius_m >= 2.4].mean()), 3),
        }
    write_occlusion(path, pictures, maps)
    return numbers


def _lying(crop: Crop) -> Crop:
    left, top, right, bottom = crop.box
    if bottom - top <= right - left:
        return crop
    size = crop.pixels.shape[1]
    turned = crop.pixels.rot90(1, (1, 2))
    return replace(crop, pixels=turned, box=(top, size - right, bottom, size - left))


def _rendered(crops: Sequence[Crop]) -> NDArray[np.bool_]:
    return np.array([crop.rendered for crop in crops])
