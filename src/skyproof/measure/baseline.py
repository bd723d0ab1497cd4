"""Baselines: what detectors find without camouflage, on photographs above all."""

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detector
from skyproof.detectors.matching import MatchTable
from skyproof.detectors.validation import average_precision, best_f1_threshold, precision_recall
from skyproof.errors import ConfigurationError
from skyproof.imagery.frames import BORDER_PX, read_frames_folder
from skyproof.measure.views import SceneView
from skyproof.results.operating_points import EQUAL_ALARMS
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH
from skyproof.results.score_folder import Baseline, BestF1
from skyproof.results.statistics.intervals import (
    Interval,
    bootstrap_interval,
    cluster_interval,
    false_alarms_per_km2,
    resample,
    share_of,
)
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.seeds import numpy_generator


@dataclass(frozen=True)
class BaselineSet:
    """Images without camouflage; a camera took `real` ones, and places are bootstrap clusters."""

    name: str
    images: Dataset
    _: KW_ONLY
    real: bool
    note: str = ""
    places: Sequence[str] = ()


def measure_baselines(
    detectors: Sequence[Detector], images: BaselineSet, view: SceneView, *, seed: int
) -> list[Baseline]:
    """Measures every detector on images without camouflage, as the view shows them.

    Intervals are over places, or over images if all show one place or none is known. All sets have
    one `seed`, so none changes another's intervals.
    """
    return [_measure(each, images, view, seed) for each in detectors]


def _measure(detector: Detector, images: BaselineSet, view: SceneView, seed: int) -> Baseline:
    generator = numpy_generator(seed)
    centre = view.matched(detector.name, MAIN_MATCH)
    by_place = len(set(images.places)) > 1
    clusters = list(images.places) if by_place else list(map(str, range(centre.images)))
    ap = ap_interval(centre, clusters, generator=generator)
    numbers = _numbers(clusters)
    precision, recall = _threshold_intervals(centre, numbers, detector.threshold, generator)
    lenient = view.matched(detector.name, LENIENT_MATCH)
    called = view.called_another_class(detector)
    area_m2 = images.images.area_m2
    # Photographs have a border without labels, which is no empty ground.
    empty = not images.real and not any(map(len, images.images.boxes))
    # Twice as many as needed show how far chance may move a threshold.
    kept = int(2 * max(EQUAL_ALARMS.values()) * area_m2 / 1e6) + 2 if empty else 0
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
        false_alarms_per_km2=false_alarms_per_km2(centre.counts_at(detector.threshold)[1], area_m2),
        note=images.note,
        best=_best(centre),
        ap_centre_in_box=average_precision(lenient),
        recall_centre_in_box=_share(lenient.found_at(detector.threshold)),
        called_another_class=float("nan") if called is None else _share(called),
        area_km2=area_m2 / 1e6,
        alarm_scores=tuple(centre.scores[:kept].tolist()),
        alarm_clusters=tuple(numbers[centre.image_of_detection[:kept]].tolist()),
    )


def _share(vehicles: Bool[np.ndarray, " T"]) -> float:
    """Returns the share of vehicles that are marked; nan without a vehicle."""
    return float(vehicles.mean()) if len(vehicles) else float("nan")


def _best(matches: MatchTable) -> BestF1 | None:
    """Precision and recall at the threshold of the largest F1; None without a vehicle."""
    if not matches.vehicles:
        return None
    threshold, _ = best_f1_threshold(precision_recall(matches))
    hits, false_alarms = matches.counts_at(threshold)
    counted = hits + false_alarms
    precision = hits / counted if counted else float("nan")
    return BestF1(threshold, precision, hits / matches.vehicles)


def _threshold_intervals(
    matches: MatchTable,
    cluster_of_image: Int64[np.ndarray, " images"],
    threshold: float,
    generator: np.random.Generator,
) -> tuple[Interval, Interval]:
    """Precision and recall at a threshold with 95 % intervals, undefined as in `ap_interval`."""
    counting = matches.counting_at(threshold)
    count = int(cluster_of_image.max(initial=-1)) + 1
    detected = matches.image_of_detection
    images = (detected[counting & matches.hits], detected[counting], matches.image_of_vehicle)
    per_cluster = [np.bincount(cluster_of_image[each], minlength=count) for each in images]
    counts = np.stack(per_cluster, axis=-1)[None]
    weights = resample(count, generator=generator)

    def share(of: int) -> Interval:
        def rate(sums: np.ndarray) -> np.ndarray:
            return share_of(sums[..., 0, 0], sums[..., 0, of])

        return cluster_interval(counts, rate, weights, limits=(0.0, 1.0))

    return share(1), share(2)


def ap_interval(
    matches: MatchTable,
    clusters: Sequence[str],
    *,
    generator: np.random.Generator,
    replicates: int = 1000,
) -> Interval:
    """Average precision with its 95 % interval, as fractions.

    Images of one place share ground, light and often the very vehicles, so places (`clusters`, one
    per image) are resampled, not images. Limits are nan with fewer than two clusters, all three
    without a vehicle.
    """
    cluster_of_image = _numbers(clusters)
    count = len(set(clusters))
    estimate = average_precision(matches)
    if count < 2:
        return Interval(estimate, float("nan"), float("nan"))

    drawn = resample(count, generator=generator, replicates=replicates)
    resampled, left_one_out = (
        np.array([average_precision(matches, row[cluster_of_image]) for row in weights])
        for weights in (drawn, 1 - np.eye(count, dtype=np.int64))
    )
    telling = len(np.unique(cluster_of_image[matches.image_of_vehicle]))
    return bootstrap_interval(estimate, resampled, left_one_out, (0.0, 1.0), telling)


def _numbers(clusters: Sequence[str]) -> Int64[np.ndarray, " images"]:
    """The number of each image's cluster, in order of appearance."""
    numbers = {name: number for number, name in enumerate(dict.fromkeys(clusters))}
    return np.array([numbers[name] for name in clusters], dtype=np.int64)


@dataclass(frozen=True)
class _FramesArgument:
    name: str
    folder: Path
    pattern: str
    labels: Path | None
    gsd_m: float
    classes: tuple[str, ...]

    @property
    def border_px(self) -> float:
        """The unlabelled border; none in skyproof's datasets, where every vehicle is labelled."""
        ours = self.labels is None and (self.folder / "annotations.json").is_file()
        return 0.0 if ours else BORDER_PX


def read_frames(texts: Sequence[str], classes: Sequence[str], gsd_m: float) -> list[BaselineSet]:
    """Reads frames given as `[NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...]`.

    An example is `kit/MOS*@0.116#car,minibus`. Without classes of its own a set has `classes`.
    LABELS (COCO file, folder of other labels) is needed if labels do not lie with the images.
    Arguments of the same NAME are one set. Each argument counts as one place or, in a set that
    `skyproof ground` cut, each source does.
    """
    by_name: dict[str, list[_FramesArgument]] = {}
    for text in texts:
        given = _parse(text, tuple(classes))
        by_name.setdefault(given.name, []).append(given)
    return [_read(name, given, gsd_m) for name, given in by_name.items()]


def _read(name: str, given: Sequence[_FramesArgument], gsd_m: float) -> BaselineSet:
    parts, places = [], []
    for number, one in enumerate(given, 1):
        read = read_frames_folder(
            one.folder,
            labels=one.labels,
            gsd_m=one.gsd_m,
            target_gsd_m=gsd_m,
            classes=one.classes,
            border_px=one.border_px,
            pattern=one.pattern,
        )
        parts.append(read)
        places += _sources(one.folder, read.ids) or [str(number)] * len(read)
    own_gsd = " and ".join(dict.fromkeys(f"{one.gsd_m * 100:.1f}" for one in given))
    rendered = any((one.folder / "scenes.jsonl").exists() for one in given)
    border = f"; {BORDER_PX:.0f} px border ignored" if any(one.border_px for one in given) else ""
    counted = ", ".join(dict.fromkeys(each for one in given for each in one.classes))
    note = (
        f"{'rendered' if rendered else 'real'} frames, {own_gsd} cm/px resampled to "
        f"{gsd_m * 100:.1f} cm/px; vehicles: {counted}{border}"
    )
    images = Dataset.joined(parts)
    return BaselineSet(name, images, real=not rendered, note=note, places=tuple(places))


def _parse(text: str, classes: tuple[str, ...]) -> _FramesArgument:
    place, _, resolution = text.rpartition("@")
    resolution, _, own = resolution.partition("#")
    name, place = re.fullmatch(r"(?:([^/=]+)=)?(.*)", place, re.S).groups("")  # type: ignore[union-attr]
    try:
        own_gsd_m = float(resolution)
    except ValueError:
        own_gsd_m = 0.0
    if not place or not 0 < own_gsd_m <= 0.5:
        raise ConfigurationError(
            "--frames expects [NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...] with metres per "
            f"pixel up to 0.5, got {text!r}; write it like my_frames@0.12."
        )
    labels = None
    if ":" in place and not Path(place).is_dir():
        place, _, elsewhere = place.rpartition(":")
        labels = Path(elsewhere)
    folder = Path(place)
    pattern = "*"
    if not folder.is_dir():
        folder, pattern = folder.parent, folder.name
        if not folder.is_dir() or not set(pattern) & set("*?["):
            raise ConfigurationError(f"{place} is not a folder; check --frames {text}.")
    shown = folder.resolve().name if pattern == "*" else f"{folder.resolve().name}/{pattern}"
    named = tuple(filter(None, own.split(","))) or classes
    return _FramesArgument(name or shown, folder, pattern, labels, own_gsd_m, named)


def _sources(folder: Path, ids: Sequence[str]) -> list[str]:
    """The source of each image of a split of a tiled set; empty for another folder."""
    if not (folder.parent / "index.json").is_file():
        return []
    tiles = BackgroundSet.open(folder.parent)
    return [tiles.tile(name).source for name in ids]
