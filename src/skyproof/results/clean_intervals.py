"""How sure an average precision is: bootstrap over the places that the images show (PAPER 40)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.detectors.matching import Criterion, match_detections
from skyproof.errors import ConfigurationError
from skyproof.results.statistics.intervals import bootstrap_interval, resample

__all__ = ["ap_interval"]

# Torch's, because `average_precision` takes these: at a recall of just 0.6 the last bit decides.
_LEVELS = torch.linspace(0, 1, 101, dtype=torch.float64).numpy()


@dataclass(frozen=True)
class _Ranked:
    """Every detection that counts, best score first, and the vehicles of each cluster."""

    hits: NDArray[np.bool_]
    cluster: NDArray[np.int64]
    vehicles: NDArray[np.int64]

    def average_precision(self, weights: Int[np.ndarray, " C"]) -> float:
        """COCO's 101-point AP when each cluster occurs that often; nan without a vehicle."""
        total = int(weights @ self.vehicles)
        if not total:
            return float("nan")
        count = weights[self.cluster]
        found = np.cumsum(count * self.hits)
        # Before the first detection that occurs there is nothing to be precise about.
        precision = found / np.maximum(np.cumsum(count), 1)
        envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
        return float(envelope[np.searchsorted(found / total, _LEVELS)].mean())


def ap_interval(
    detections: Sequence[Detections],
    labelled: Dataset,
    clusters: Sequence[str],
    *,
    criterion: Criterion,
    generator: np.random.Generator,
    replicates: int = 1000,
) -> tuple[float, float, float]:
    """Average precision with its 95 % interval, as `detectors.average_precision` computes it (PAPER 17, 19).

    Images of one place share ground, light and often the very vehicles: places are resampled, not images. Limits are
    those of all our rates (`evaluate.intervals`: BCa widened for few clusters, and no surer than the effective number
    of vehicles allows), so that with two or three places they are honest and wide.

    Args:
        detections: per image.
        labelled: the same images with their vehicles.
        clusters: per image the place it shows.
        criterion: "centre_1m" or "iou_50".
        generator: draws the replicates.
        replicates: how many.

    Returns:
        (ap, low, high), 0 to 1. The limits are nan with fewer than two clusters, all three are without a vehicle.

    Raises:
        ConfigurationError: not as many detections and clusters as images.
    """
    if not len(detections) == len(clusters) == len(labelled):
        raise ConfigurationError(
            f"Got {len(detections)} detections and {len(clusters)} places for {len(labelled)} images; give one each."
        )
    names = list(dict.fromkeys(clusters))
    ranked = _rank(
        detections, labelled, [names.index(name) for name in clusters], len(names), criterion
    )
    every = np.ones(len(names), dtype=np.int64)
    estimate = ranked.average_precision(every) if names else float("nan")
    if len(names) < 2:
        return estimate, float("nan"), float("nan")
    weights = resample(len(names), generator=generator, replicates=replicates)
    interval = bootstrap_interval(
        estimate,
        np.array([ranked.average_precision(row) for row in weights]),
        np.array(
            [ranked.average_precision(every - row) for row in np.eye(len(names), dtype=np.int64)]
        ),
        (0.0, 1.0),
    )
    return interval.estimate, interval.low, interval.high


def _rank(
    detections: Sequence[Detections],
    labelled: Dataset,
    cluster_of_image: Sequence[int],
    clusters: int,
    criterion: Criterion,
) -> _Ranked:
    scores: list[Float[np.ndarray, " k"]] = [np.zeros(0)]
    hits, cluster = [np.zeros(0, dtype=bool)], [np.zeros(0, dtype=np.int64)]
    vehicles = np.zeros(clusters, dtype=np.int64)
    for found, truth, ignore, own in zip(
        detections, labelled.boxes, labelled.ignore, cluster_of_image, strict=True
    ):
        boxes, own_scores = found.boxes.cpu(), found.scores.cpu()
        matches = match_detections(
            boxes,
            own_scores,
            truth.cpu(),
            criterion=criterion,
            gsd_m=labelled.gsd_m,
            ignore=ignore.cpu(),
        )
        counted = ~matches.ignored
        scores.append(own_scores[counted].double().numpy())
        hits.append((matches.truth_of_detection[counted] >= 0).numpy())
        cluster.append(np.full(int(counted.sum()), own))
        vehicles[own] += len(truth)
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return _Ranked(np.concatenate(hits)[order], np.concatenate(cluster)[order], vehicles)
