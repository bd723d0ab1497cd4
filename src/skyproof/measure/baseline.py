"""Detectors on images without camouflage, photographs above all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import (
    average_precision,
    best_f1_threshold,
    precision_recall,
)
from skyproof.detectors.detector import Detector
from skyproof.detectors.matching import MatchTable
from skyproof.errors import ConfigurationError
from skyproof.measure.views import View, look
from skyproof.results.baseline import Baseline, BestF1
from skyproof.results.result import MAIN_MATCH
from skyproof.results.statistics.intervals import (
    Interval,
    bootstrap_interval,
    cluster_interval,
    resample,
)
from skyproof.results.statistics.rates import false_alarms_per_km2
from skyproof.seeds import numpy_generator


@dataclass(frozen=True)
class BaselineSet:
    """Images without camouflage that say how good the detectors are.

    Attributes:
        name: the set's name in the report.
        images: at the detectors' resolution.
        real: whether a camera took them; False for rendered ones.
        note: where they come from and what was done to them.
        places: per image the place it shows, as the bootstrap's clusters; empty where not known.
    """

    name: str
    images: Dataset
    _: KW_ONLY
    real: bool
    note: str = ""
    places: Sequence[str] = ()


def measure_baseline(detector: Detector, images: BaselineSet, view: View, *, seed: int) -> Baseline:
    """Says how good a detector is on images without camouflage.

    Intervals are over places; over images where all show one place, or none is known.

    Args:
        detector: its threshold says which detections count.
        images: what they are, and where.
        view: what it finds in them.
        seed: of the bootstrap. Each set draws alike, so that one more changes no other's interval.
    """
    generator = numpy_generator(seed)
    centre = view.matched(detector.name, MAIN_MATCH)
    by_place = len(set(images.places)) > 1
    clusters = list(images.places) if by_place else list(map(str, range(centre.images)))
    ap = ap_interval(centre, clusters, generator=generator)
    precision, recall = threshold_intervals(
        centre, clusters, detector.threshold, generator=generator
    )
    return Baseline(
        detector=detector.name,
        dataset=images.name,
        images=centre.images,
        vehicles=centre.vehicles,
        real=images.real,
        ap_centre_1m=ap,
        clustered_by="places" if by_place else "images",
        clusters=len(set(clusters)),
        ap_iou_50=average_precision(view.matched(detector.name, "iou_50")),
        precision=precision,
        recall=recall,
        threshold=detector.threshold,
        false_alarms_per_km2=false_alarms_per_km2(
            centre.counts_at(detector.threshold)[1], images.images.area_m2
        ),
        note=images.note,
        best=_best(centre),
    )


def measure_baselines(
    detectors: Sequence[Detector],
    sets: Sequence[BaselineSet],
    *,
    seed: int,
    progress: Callable[[int], None] | None = None,
) -> list[Baseline]:
    """Says how good every detector is on every set, set by set.

    Args:
        detectors: with their cards.
        sets: of the detectors' resolution.
        seed: of the bootstrap.
        progress: called with the number of images of each set that was looked at.
    """
    baselines = []
    for images in sets:
        view = look(detectors, images.name, images.images)
        baselines += [measure_baseline(each, images, view, seed=seed) for each in detectors]
        if progress:
            progress(len(images.images))
    return baselines


def _best(matches: MatchTable) -> BestF1 | None:
    """What the threshold of the largest F1 reaches; None where there is no vehicle."""
    if not matches.vehicles:
        return None
    threshold, _ = best_f1_threshold(precision_recall(matches))
    hits, false_alarms = matches.counts_at(threshold)
    return BestF1(threshold, _share(hits, hits + false_alarms), hits / matches.vehicles)


def threshold_intervals(
    matches: MatchTable,
    clusters: Sequence[str],
    threshold: float,
    *,
    generator: np.random.Generator,
) -> tuple[Interval, Interval]:
    """Gives precision and recall at a threshold with their 95 % intervals.

    Args:
        matches: the images, matched.
        clusters: per image the place it shows; places are resampled.
        threshold: from which on a detection counts.
        generator: draws the replicates.

    Returns:
        Precision and recall as fractions; the limits are nan with fewer than two clusters, all
        three where there is nothing to divide by.
    """
    names = list(dict.fromkeys(clusters))
    cluster_of_image = np.array([names.index(name) for name in clusters], dtype=np.int64)
    counting = matches.counting_at(threshold)

    def per_cluster(images: np.ndarray) -> np.ndarray:
        return np.bincount(cluster_of_image[images], minlength=len(names))

    counts = np.stack(
        [
            per_cluster(matches.image_of_detection[counting & matches.hits]),
            per_cluster(matches.image_of_detection[counting]),
            per_cluster(matches.image_of_vehicle),
        ],
        axis=-1,
    )[None]
    weights = resample(len(names), generator=generator)

    def share(of: int) -> Interval:
        def rate(sums: np.ndarray) -> np.ndarray:
            below = sums[..., 0, of].astype(np.float64)
            return np.divide(
                sums[..., 0, 0], below, out=np.full_like(below, np.nan), where=below > 0
            )

        return cluster_interval(counts, rate, weights, limits=(0.0, 1.0))

    return share(1), share(2)


def ap_interval(
    matches: MatchTable,
    clusters: Sequence[str],
    *,
    generator: np.random.Generator,
    replicates: int = 1000,
) -> Interval:
    """Gives average precision with its 95 % interval.

    Images of one place share ground, light and often the very vehicles: places are resampled, not
    images. Limits are those of all our rates (`bootstrap_interval`: BCa widened for few clusters,
    and no surer than the effective number of vehicles allows), so that with two or three places
    they are honest and wide.

    Args:
        matches: the images, matched.
        clusters: per image the place it shows.
        generator: draws the replicates.
        replicates: how many.

    Returns:
        Fractions. The limits are nan with fewer than two clusters, all three without a vehicle.

    Raises:
        ConfigurationError: there are not as many clusters as images.
    """
    if len(clusters) != matches.images:
        raise ConfigurationError(
            f"Got {len(clusters)} places for {matches.images} images; give one each."
        )
    names = list(dict.fromkeys(clusters))
    cluster_of_image = np.array([names.index(name) for name in clusters], dtype=np.int64)
    every = np.ones(len(names), dtype=np.int64)
    estimate = average_precision(matches)
    if len(names) < 2:
        return Interval(estimate, float("nan"), float("nan"))

    def replicate(weights: np.ndarray) -> float:
        return average_precision(matches, weights[cluster_of_image])

    weights = resample(len(names), generator=generator, replicates=replicates)
    left_out = every - np.eye(len(names), dtype=np.int64)
    return bootstrap_interval(
        estimate,
        np.array([replicate(row) for row in weights]),
        np.array([replicate(row) for row in left_out]),
        (0.0, 1.0),
        telling=len(set(cluster_of_image[matches.image_of_vehicle].tolist())),
    )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
