"""Detectors both ways: ours as MAITE models, and MAITE models as our detectors."""

import copy
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector, checked_answers, suppressed
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ConfigurationError, DetectorAnswerError
from skyproof.maite.datasets import LABELS, Target

_ROUNDING = 1e-6


class DetectorModel:
    """A detector of ours as a MAITE object-detection model.

    Detections below the threshold are returned, too, so that MAITE's metrics see the whole curve.
    The detector is a folder, or a result of `load_detector`.

    Attributes:
        metadata: `id`, the name and the first digits of a digest of weights and threshold, because
            tools file results under it; `index2label`; and our additions `threshold` and `gsd_m`.
    """

    def __init__(self, detector: str | Path | Detector) -> None:
        loaded = load_detector(detector) if isinstance(detector, str | Path) else detector
        self._loaded = loaded
        identity = f"{loaded.weights_sha256} {loaded.threshold!r}"
        digest = hashlib.sha256(identity.encode()).hexdigest()
        self.metadata: dict[str, Any] = {
            "id": f"{loaded.name}-{digest[:12]}",
            "index2label": dict(LABELS),
            "threshold": loaded.threshold,
            "gsd_m": loaded.card.gsd_m,
        }

    def __call__(self, batch_input: Sequence[Any], /) -> Sequence[Target]:
        """Finds vehicles; images may differ in size, and large ones are split into windows.

        Images are `[3, H, W]`, whole numbers 0 to 255 or floats 0 to 1.
        """
        images = [_bytes_of(image) for image in batch_input]
        unknown = [torch.zeros(0, 4)] * len(images)
        shown = Dataset.of_images(images, unknown, gsd_m=self._loaded.card.gsd_m)
        with torch.no_grad():
            found = detect_all(self._loaded, shown)
        return [Target.of(each.boxes, each.scores) for each in found]


class ModelDetector(BlackBoxDetector):
    """A MAITE object-detection model as a black-box detector.

    Its name is the model's `id`, with hyphens for characters that file names do not allow.

    Args:
        model: any MAITE model of object detection.
        vehicle_classes: vehicle classes by their names in `index2label`; may be left out if that
            has one class.
        largest_value: largest value of its input images: 1 for floats in [0, 1], 255 for bytes.
            MAITE does not prescribe it, and a model with the wrong range finds nothing, or the
            wrong objects.

    Raises:
        ConfigurationError: the model lacks the classes, or has several and none was named.
    """

    def __init__(
        self, model: Any, *, vehicle_classes: Sequence[str] = (), largest_value: Literal[1, 255] = 1
    ) -> None:
        metadata: Mapping[str, Any] = model.metadata
        name = re.sub(r"[^\w.-]+", "-", str(metadata["id"])).strip("-.") or "model"
        super().__init__(self._query, name)
        self._model = model
        self._bytes = largest_value == 255
        self._labels = _vehicle_labels(metadata, vehicle_classes, name)
        # Some models also give scores to a label that means no object.
        self._others = [
            int(label)
            for label, text in metadata["index2label"].items()
            if int(label) not in self._labels and str(text).strip("_ ").lower() != "background"
        ]

    def of_other_classes(self) -> "ModelDetector | None":
        others = copy.copy(self)
        others._labels, others._detect = self._others, others._query
        return others if self._others else None

    def _query(self, images: Float[Tensor, "B 3 H W"]) -> list[Detections]:
        shown = images.detach().cpu()
        if self._bytes:
            shown = (shown * 255).round().byte()
        answers = self._model([np.ascontiguousarray(image.numpy()) for image in shown])
        return [suppressed(found_vehicles(answer, self._labels)) for answer in answers]


def is_maite_model(thing: object) -> bool:
    """Whether an object is called like a MAITE model, and not through `detect`."""
    metadata = getattr(thing, "metadata", None)
    return (
        callable(thing)
        and not hasattr(thing, "detect")
        and isinstance(metadata, Mapping)
        and "id" in metadata
    )


def _vehicle_labels(
    metadata: Mapping[str, Any], vehicle_classes: Sequence[str], name: str
) -> list[int]:
    known: Mapping[int, str] = metadata.get("index2label") or {}
    if not known:
        raise ConfigurationError(
            f"The metadata of the MAITE model {name} have no index2label, so that nothing says "
            "which labels are vehicles; add it, such as {0: 'vehicle'}."
        )
    named = ", ".join(map(str, known.values()))
    if not vehicle_classes and len(known) > 1:
        raise ConfigurationError(
            f"The MAITE model {name} knows {len(known)} classes ({named}); say with "
            "vehicle_classes which of them are vehicles."
        )
    wanted = vehicle_classes or [*known.values()]
    missing = next((each for each in wanted if each not in known.values()), None)
    if missing is not None:
        raise ConfigurationError(
            f"The MAITE model {name} knows no class {missing!r}; choose from {named}."
        )
    return [int(label) for label, text in known.items() if text in wanted]


def _bytes_of(image: Any) -> UInt8[Tensor, "3 H W"]:
    """Reads a MAITE image, any array-like `[3, H, W]` of 0 to 255, or of fractions, as bytes."""
    values = np.asarray(image)
    if values.ndim != 3 or values.shape[0] != 3:
        raise ConfigurationError(
            f"An image is [3, height, width] to skyproof, got {list(values.shape)}; give RGB "
            "images, channels first."
        )
    whole = np.issubdtype(values.dtype, np.integer)
    most = 255 if whole else 1
    # NaN is neither below nor above the range, so the test is whether all values lie inside.
    if values.size and not (values.min() >= 0 and values.max() <= most):
        raise ConfigurationError(
            f"Images of {'whole numbers' if whole else 'floats'} are sRGB from 0 to {most} to "
            f"skyproof, got {values.min():.4g} to {values.max():.4g}; bring them into that range."
        )
    shown = values if whole else (values.astype(np.float32) * 255).round()
    return torch.from_numpy(shown.astype(np.uint8))


def found_vehicles(target: Any, labels: Sequence[int]) -> Detections:
    """Reads a MAITE model's answer to one image: its possible vehicles, sorted by falling score.

    Scores are `[N]` or `[N, classes]`. Those of several classes exclude each other, because MAITE
    lets them sum to at most 1, so the scores of all vehicle classes (`labels`) are added up. A
    ValueError tells of an answer of another shape, or of scores that are none.
    """
    boxes = np.asarray(target.boxes, dtype=np.float32).reshape(-1, 4)
    scores = np.asarray(target.scores, dtype=np.float32)
    if not len(boxes):
        return Detections(torch.zeros(0, 4), torch.zeros(0))
    if scores.min() < 0 or scores.max() > 1 + _ROUNDING:
        raise ValueError(f"scores lie in [0, 1], got {scores.min():.4g} to {scores.max():.4g}")
    if scores.ndim == 2:
        likely = scores[:, list(labels)].sum(1)
    else:
        likely = np.where(np.isin(np.asarray(target.labels), labels), scores, 0)
    if likely.shape != (len(boxes),):
        raise ValueError(f"{len(boxes)} boxes with scores of shape {list(scores.shape)}")
    # Boxes that are certainly no vehicle are dropped; NaN stays, so that a later check notices it.
    kept = ~(likely <= 0)
    order = np.argsort(-likely[kept], kind="stable")
    # MAITE allows sums to exceed 1 by rounding.
    certain = np.where(likely[kept] < 1 + _ROUNDING, np.minimum(likely[kept], 1), likely[kept])
    return Detections(
        torch.from_numpy(boxes[kept][order]), torch.from_numpy(certain[order].astype(np.float32))
    )


def checked_vehicles(
    answers: Any, labels: Sequence[int], name: str, sizes_px: Sequence[tuple[int, int]]
) -> list[Detections]:
    """Reads a model's answers by `found_vehicles`, and checks them as `checked_answers` does."""
    try:
        found = [found_vehicles(answer, labels) for answer in answers]
    except Exception as error:
        # Answers are objects of another program.
        raise DetectorAnswerError(
            f"The model {name} gave an answer that cannot be one "
            f"({' '.join(str(error).split())[:200]}); correct it."
        ) from error
    return checked_answers(found, name, sizes_px)
