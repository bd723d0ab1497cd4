"""Matched statistics as a MAITE metric: the vehicles that a change of the images hides."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError
from skyproof.maite.datasets import batches
from skyproof.maite.models import checked_vehicles
from skyproof.ranges import Fraction, Match, check_value
from skyproof.results.outcomes import Cell, count_pairs
from skyproof.results.rows_file import interval_columns, nulls_for_undefined
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.intervals import Sample, attack_success_rate, enhancement_rate
from skyproof.seeds import numpy_generator

_RATES = ("easr", "easr_low", "easr_high", "asr", "asr_low", "asr_high", "er")
_NO_PIXELS = torch.zeros(3, 0, 0, dtype=torch.uint8)
# A vehicle: its image's id, and its number in the scene or among the boxes.
_Vehicle = tuple[str, int]


class HiddenVehicles:
    """The share of found vehicles that a model misses after a change: our EASR with its interval.

    The model sees the unchanged images once; MAITE's `evaluate` then passes the results on the
    changed ones. The change is a camouflage, or any augmentation that keeps every vehicle. `id`
    identifies an image; `placements` in the metadata, else the order of boxes, a vehicle.

    Args:
        model: the MAITE model to evaluate.
        dataset: the MAITE dataset without the change.
        threshold: score at or above which a detection counts; None takes that of the model's
            metadata.
        labels: vehicle classes of the model, and of the dataset if it has several classes.
        gsd_m: metres per pixel; None takes `img_gsd` of the metadata.
        match: rule that pairs detections with vehicles, a criterion of `match_detections`.
        batch_size: images per call of the model.

    Raises:
        ConfigurationError: threshold or resolution are not known, the model was made for another
            resolution, or no box has one of the labels.
        DetectorAnswerError: an answer of the model cannot be one.
    """

    def __init__(
        self,
        model: Any,
        dataset: Any,
        *,
        threshold: float | None = None,
        labels: Sequence[int] = (0,),
        gsd_m: float | None = None,
        match: Match = "centre_1m",
        batch_size: int = 8,
    ) -> None:
        known = model.metadata.get("threshold") if threshold is None else threshold
        if known is None:
            raise ConfigurationError(
                "The model's metadata name no threshold; give the score from which on a detection "
                "counts."
            )
        self.metadata: dict[str, Any] = {"id": f"skyproof-hidden-vehicles-{match}"}
        check_value("The threshold", known, Fraction)
        self._threshold = float(known)
        self._name = str(model.metadata.get("id", "model"))[:100]
        self._labels = labels
        # A dataset of one class holds only vehicles, under any name.
        self._one_class = len(dataset.metadata.get("index2label") or ()) == 1
        self._gsd_m = gsd_m
        self._made_for_m = model.metadata.get("gsd_m")
        self._match: Match = match
        # By the id of each unchanged image.
        self._renderings: dict[str, Any] = {}
        self._sizes_px: dict[str, tuple[int, int]] = {}
        self._numbers: dict[str, list[int]] = {}
        others: set[int] = set()
        # The place and the name of each vehicle, because the intervals cover both.
        self._cells: dict[_Vehicle, Cell] = {}
        self._before: dict[_Vehicle, bool] = {}
        self.reset()
        for images, targets, metadata in batches(dataset, batch_size):
            self._renderings |= {str(known["id"]): known.get("rendering") for known in metadata}
            self._sizes_px |= {
                str(known["id"]): (np.shape(image)[-1], np.shape(image)[-2])
                for image, known in zip(images, metadata, strict=True)
            }
            self._before |= self._found(model(images), targets, metadata)
            others |= {int(label) for target in targets for label in np.ravel(target.labels)}
        if others and not self._before:
            raise ConfigurationError(
                f"Vehicles are the labels {', '.join(map(str, labels))}, and the dataset's boxes "
                f"have {', '.join(map(str, sorted(others)[:20]))}; give those of its vehicles as "
                "labels, in the numbers that model and dataset share."
            )

    def reset(self) -> None:
        """Forgets the changed images, but not the unchanged ones."""
        self._changed: set[str] = set()
        self._after: dict[_Vehicle, bool] = {}

    def update(
        self,
        pred_batch: Sequence[Any],
        target_batch: Sequence[Any],
        metadata_batch: Sequence[Mapping[str, Any]],
        /,
    ) -> None:
        """Adds the model's results on some changed images.

        It refuses an image that is not among the unchanged ones, that was rendered by another
        renderer or with other settings, or that was added before.
        """
        changed: set[str] = set()
        for known in metadata_batch:
            image = str(known["id"])
            if image not in self._renderings:
                raise ConfigurationError(
                    f"Image {image[:100]!r} is none of the unchanged dataset's; give the metric "
                    "the dataset that the changed images were made of."
                )
            if image in self._changed | changed:
                raise ConfigurationError(
                    f"Image {image[:100]!r} came twice; give each once, and reset the metric "
                    "before another run."
                )
            renderings = [known.get("rendering"), self._renderings[image]]
            if None not in renderings and len(set(renderings)) > 1:
                raise ConfigurationError(
                    f"Image {image[:100]!r} was rendered by another renderer or with other "
                    "settings than the unchanged one, so that they differ in more than the "
                    "change; render both with the same."
                )
            changed.add(image)
        self._after |= self._found(pred_batch, target_batch, metadata_batch)
        # An image whose answer was refused counts for nothing.
        self._changed |= changed

    def compute(self) -> dict[str, Any]:
        """Returns the rates, which are None if no vehicle was found before, and the counts.

        `easr` is `asr` minus `er`. `easr_low` and `easr_high` are its 95 % interval over places and
        vehicles; `asr` has such limits, too. Only images with both versions count.
        """
        vehicles = [vehicle for vehicle in self._before if vehicle[0] in self._changed]
        cells = sorted({self._cells[vehicle] for vehicle in vehicles})
        row_of = {cell: row for row, cell in enumerate(cells)}
        # A vehicle that the change puts out of sight is not found.
        pairs = (
            (self._cells[vehicle], self._before[vehicle], self._after.get(vehicle, False))
            for vehicle in vehicles
        )
        counts = count_pairs(pairs, row_of)[None]
        both, hidden, gained = (int(number) for number in counts.sum((0, 1)))
        told = {
            "vehicles": len(vehicles),
            "found_before": both + hidden,
            "hidden": hidden,
            "found_only_since": gained,
            "places": len({place for place, _ in cells}),
        }
        if not both + hidden:
            return {**dict.fromkeys(_RATES), **told}
        group = Group(counts, Sample.draw(cells, generator=numpy_generator(0)))
        asr = mean_interval(group, rate=attack_success_rate, limits=(0.0, 1.0))
        rates = interval_columns("easr", mean_interval(group)) | interval_columns("asr", asr)
        rates["er"] = float(enhancement_rate(counts.sum(1)[0]))
        return {**nulls_for_undefined(rates), **told}

    def _found(
        self,
        predictions: Sequence[Any],
        targets: Sequence[Any],
        metadata: Sequence[Mapping[str, Any]],
    ) -> dict[_Vehicle, bool]:
        """Matches the detections of a batch with its vehicles, and tells which are found."""
        seen: dict[_Vehicle, bool] = {}
        sizes_px = [self._sizes_px[str(known["id"])] for known in metadata]
        detections = checked_vehicles(predictions, self._labels, self._name, sizes_px)
        for found, target, known in zip(detections, targets, metadata, strict=True):
            boxes = torch.as_tensor(np.asarray(target.boxes, dtype=np.float32)).reshape(-1, 4)
            image = str(known["id"])
            numbers = self._numbers_of(image, known, len(boxes))
            names = known.get("vehicles", [f"{image} {number}" for number in numbers])
            if not self._one_class:
                vehicles = np.isin(np.ravel(target.labels), self._labels).nonzero()[0].tolist()
                boxes = boxes[vehicles]
                numbers = [numbers[index] for index in vehicles]
                names = [names[index] for index in vehicles]
            ignore = torch.tensor(known.get("ignore", []), dtype=torch.float32).reshape(-1, 4)
            # The matcher only reads labels.
            gsd_m = self._resolution(known)
            labelled = Dataset.of_images([_NO_PIXELS], [boxes], gsd_m=gsd_m, ignore=[ignore])
            table = match_images([found], labelled, criterion=self._match)
            reached = table.found_at(self._threshold).tolist()
            for index, is_found in zip(table.index_of_vehicle.tolist(), reached, strict=True):
                vehicle = (image, numbers[index])
                seen[vehicle] = is_found
                cell = (str(known.get("place", image)), str(names[index]))
                self._cells.setdefault(vehicle, cell)
        return seen

    def _numbers_of(self, image: str, known: Mapping[str, Any], boxes: int) -> list[int]:
        """Returns the numbers that identify the vehicles of an image, one per box."""
        before = self._numbers.get(image, range(boxes))
        numbers = list(known.get("placements", before))
        if not boxes == len(numbers) == len(known.get("vehicles", numbers)):
            raise ConfigurationError(
                f"Image {image[:100]!r} comes with {boxes} boxes of {len(numbers)} vehicles, so "
                "that it is not known which is which; give every box its number in placements, or "
                "a change that keeps all boxes."
            )
        self._numbers.setdefault(image, numbers)
        return numbers

    def _resolution(self, known: Mapping[str, Any]) -> float:
        gsd_m = known.get("img_gsd") if self._gsd_m is None else self._gsd_m
        if gsd_m is None:
            raise ConfigurationError(
                "The images' metadata name no img_gsd; give gsd_m, the metres per pixel."
            )
        if self._made_for_m is not None and not math.isclose(self._made_for_m, float(gsd_m)):
            raise ConfigurationError(
                f"The model was made for {self._made_for_m:g} m per pixel but the images have "
                f"{float(gsd_m):g} m; give a model and images of one resolution."
            )
        return float(gsd_m)
