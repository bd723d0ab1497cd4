"""Uses any callable as a detector, and checks its answers: it may fail, or return nonsense."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torchvision import ops

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import LOWEST_SCORE, SUPPRESSION_IOU, Detections, Detector
from skyproof.detectors.validation import frozen_card
from skyproof.errors import ConfigurationError, DetectorAnswerError, SkyproofError
from skyproof.ranges import is_name

Answering = Callable[[Any], Sequence[object]]
"""A function from images to the boxes and scores of each; see `BlackBoxDetector`."""

_GO_ON = "the same command goes on where it stopped"


class BlackBoxDetector(Detector):
    """A detector known only by its detections, which are checked.

    A callable, or the method `detect` of an object, takes sRGB images `[B, 3, H, W]` in [0, 1] and
    returns boxes `[K, 4]` (left, top, right, bottom in pixels) and scores `[K]` in [0, 1] for each
    image: as a pair, or as attributes or items called `boxes` and `scores`. Its name in tables is
    that of the card, else `name`, else its own `name` or `__name__`. With `vehicle_classes`,
    answers also have `labels` `[K]`, the boxes' classes: names, or numbers compared as text.
    """

    _vehicle_classes: frozenset[str]

    def __init__(
        self,
        detector: object,
        name: str | None = None,
        card: DetectorCard | None = None,
        vehicle_classes: Sequence[str] = (),
    ) -> None:
        own = getattr(detector, "name", None) or getattr(detector, "__name__", "").strip("<>")
        self.name = own if name is None else name
        if card is not None:
            self.set_card(card)
        # Unwrapped, so that the answers of another BlackBoxDetector are checked only once.
        wrapped: Any = detector
        if isinstance(detector, BlackBoxDetector):
            wrapped = detector._detect
            vehicle_classes = vehicle_classes or [*detector._vehicle_classes]
        self._detect: Any = getattr(wrapped, "detect", wrapped)
        self._wrapped = detector
        self.window_px = getattr(detector, "window_px", self.window_px)
        self._vehicle_classes = frozenset(vehicle_classes)
        self._finds_others = False
        self._classes_seen: set[str] = set()
        if not callable(self._detect) or not isinstance(self.name, str) or not is_name(self.name):
            raise ConfigurationError(
                "A detector is a folder, a file, or a callable with a plain name (no separators, "
                f"not dots alone), got {type(detector).__name__} named {str(self.name)[:100]!r}; "
                "give a function from images to boxes and scores, and name=."
            )

    def freeze(self, labelled: Dataset | None) -> None:
        """Freezes the threshold on labelled images, which gives the detector its card."""
        if labelled is None:
            raise ConfigurationError(
                f"The threshold of {self.name} is frozen on labelled images, got none; give a "
                "Dataset."
            )
        remedy = "check that its boxes are left, top, right, bottom in pixels"
        self._classes_seen.clear()
        try:
            card = frozen_card(self, labelled, remedy)
        except ConfigurationError:
            self._refuse_unclear_classes()
            raise
        self._refuse_unclear_classes()
        self.set_card(card)

    def _refuse_unclear_classes(self) -> None:
        """Refuses classes that do not tell vehicles from other objects."""
        seen = ", ".join(sorted(self._classes_seen))[:500]
        if not self._vehicle_classes and len(self._classes_seen) > 1:
            raise ConfigurationError(
                f"{self.name} answers with {len(self._classes_seen)} classes ({seen}), and nothing "
                "says which of them are vehicles; name them with vehicle_classes of sp.assess, or "
                "return vehicles alone."
            )
        if seen and self._vehicle_classes and not self._vehicle_classes & self._classes_seen:
            asked = ", ".join(sorted(self._vehicle_classes))[:500]
            raise ConfigurationError(
                f"{self.name} answers with none of the vehicle_classes ({asked}), but with {seen}; "
                "choose from these."
            )

    def of_other_classes(self) -> "BlackBoxDetector | None":
        if self._vehicle_classes:
            others = copy.copy(self)
            others._finds_others = True
            return others
        wrapped = self._wrapped.of_other_classes() if isinstance(self._wrapped, Detector) else None
        return None if wrapped is None else BlackBoxDetector(wrapped, self.name)

    def _are_meant(self, answer: Any, count: int) -> list[bool]:
        """Says which boxes of an answer belong to the wanted classes: all, if none were named."""
        try:
            classes = _classes(answer) if count else []
            if len(classes) != count:
                raise ValueError(f"{len(classes)} labels of {count} boxes")
        except Exception as error:
            # Answers are objects of another program.
            if not self._vehicle_classes:
                return [True] * count
            what = f"with vehicle_classes each box has one of the labels, got {_in_short(error)}"
            raise _Wrong(what) from error
        self._classes_seen.update(classes)
        own = self._vehicle_classes
        return [not own or (each in own) != self._finds_others for each in classes]

    @torch.no_grad()
    def detect(self, images: Float[Tensor, "B 3 H W"]) -> list[Detections]:
        """See `Detector.detect`; a DetectorAnswerError says how it failed."""
        try:
            answers = self._detect(images)
        except BaseException as error:
            # A foreign program may raise anything, SystemExit included; Ctrl-C is the user's.
            if isinstance(error, SkyproofError) or type(error) is KeyboardInterrupt:
                raise
            raise DetectorAnswerError(
                f"The detector {self.name} did not answer ({_in_short(error)}); see that it runs, "
                f"and {_GO_ON}."
            ) from error
        remedy = f"correct it, and {_GO_ON}"
        sizes_px = [(images.shape[-1], images.shape[-2])] * len(images)
        found = checked_answers(answers, self.name, sizes_px, remedy, self._are_meant)
        return [suppressed(each) for each in found] if self._vehicle_classes else found


def suppressed(found: Detections) -> Detections:
    """Keeps the best of overlapping boxes of several vehicle classes.

    Most programs suppress class by class, so a van that may also be a car is reported twice.
    """
    # NaN stays, so that a later check notices it.
    likely = ~(found.scores < LOWEST_SCORE)
    boxes, scores = found.boxes[likely], found.scores[likely]
    best = ops.nms(boxes, scores, SUPPRESSION_IOU)
    return Detections(boxes[best], scores[best])


def checked_answers(
    answers: Any,
    name: str,
    sizes_px: Sequence[tuple[int, int]],
    remedy: str = "correct it",
    are_meant: Callable[[Any, int], list[bool]] | None = None,
) -> list[Detections]:
    """Checks the answers of the detector `name` to images of `sizes_px`, width first.

    The result is sorted by falling score and cut at the borders of the images. `are_meant` gets an
    answer and its number of boxes, and says which of them count. A DetectorAnswerError says what is
    wrong with an answer, and which mistake it suggests.
    """
    beginning = f"The detector {name} gave an answer that cannot be one: "
    try:
        if not isinstance(answers, Sequence) or len(answers) != len(sizes_px):
            count = len(answers) if isinstance(answers, Sequence) else type(answers).__name__
            raise _Wrong(f"{len(sizes_px)} images expect as many answers, got {count}")
        return [_checked(*each, are_meant) for each in zip(answers, sizes_px, strict=True)]
    except _Wrong as wrong:
        raise DetectorAnswerError(f"{beginning}{wrong}; {remedy}.") from wrong.__cause__


class _Wrong(Exception):
    """An invalid answer: what was expected, and what came."""


def _checked(
    answer: Any, size_px: tuple[int, int], are_meant: Callable[[Any, int], list[bool]] | None
) -> Detections:
    try:
        boxes, scores = map(_numbers, _parts(answer))
    except Exception as error:
        # Answers are objects of another program.
        raise _Wrong(f"each image expects boxes and scores, got {_in_short(error)}") from error
    if scores.ndim != 1 or (tuple(boxes.shape) != (len(scores), 4) and boxes.numel()):
        shapes = f"{[*boxes.shape]} and {[*scores.shape]}"
        raise _Wrong(f"boxes are [K, 4] and scores [K], got {shapes}")
    if len(scores) and not boxes.numel():
        raise _Wrong(f"every score has a box, got {len(scores)} scores without boxes")
    boxes = boxes.reshape(-1, 4)
    if not (boxes.isfinite().all() and scores.isfinite().all()):
        raise _Wrong("boxes and scores are finite numbers, got NaN or infinity")
    if len(scores) and not (scores.min() >= 0 and scores.max() <= 1):
        raise _Wrong(f"scores lie in [0, 1], got {scores.min():.4g} to {scores.max():.4g}")
    limits = torch.tensor([*size_px, *size_px], dtype=torch.float32)
    turned = (boxes[:, 2:] < boxes[:, :2]).any(1)
    outside = (boxes[:, :2] >= limits[:2]).any(1) | (boxes[:, 2:] <= 0).any(1)
    if bool(turned.any()):
        # If the last two numbers are a size, a box reaches half of it beyond the first two.
        sized = bool((boxes >= 0).all() and (boxes[:, :2] + boxes[:, 2:] / 2 <= limits[:2]).all())
        unit = " in fractions of the image" if float(boxes.max()) <= 1 else ""
        raise _Wrong(
            "boxes are left, top, right, bottom in pixels, got one whose right or bottom comes "
            "before its left or top"
            f"{f', as if they were a width and a height{unit}' if sized else ''}"
        )
    if bool(outside.any()):
        box = [round(value, 1) for value in boxes[outside][0].tolist()]
        times = float((boxes[:, 2:] / limits[2:]).max())
        enlarged = f", as if the image were enlarged {times:.1f} times" if times > 1.2 else ""
        raise _Wrong(
            f"boxes lie in the image of {size_px[0]} x {size_px[1]} px, got one at {box}{enlarged}"
        )
    if are_meant is not None:
        meant = torch.tensor(are_meant(answer, len(scores)), dtype=torch.bool)
        boxes, scores = boxes[meant], scores[meant]
    order = scores.argsort(descending=True, stable=True)
    return Detections(boxes[order].clamp(min=0).minimum(limits), scores[order])


def _numbers(part: Any) -> Tensor:
    """Reads boxes or scores from a tensor, or from what NumPy can make an array of."""
    if isinstance(part, Tensor):
        # NumPy refuses what is sparse, nested or without numbers.
        return torch.from_numpy(part.detach().float().cpu().numpy())
    # A copy, because torch refuses arrays with negative strides.
    return torch.from_numpy(np.array(part, dtype=np.float64)).float()


def _parts(answer: Any) -> tuple[Any, Any]:
    if isinstance(answer, Mapping):
        return answer["boxes"], answer["scores"]
    if isinstance(answer, tuple | list):
        boxes, scores = answer
        return boxes, scores
    return answer.boxes, answer.scores


def _classes(answer: Any) -> list[str]:
    """The class of each box as text; empty if the answer has no labels."""
    mapping = isinstance(answer, Mapping)
    labels = answer.get("labels", ()) if mapping else getattr(answer, "labels", ())
    values = labels.detach().cpu().numpy() if isinstance(labels, Tensor) else np.array(labels)
    if values.ndim != 1:
        raise ValueError(f"labels of shape {[*values.shape]}")
    numbers = np.issubdtype(values.dtype, np.floating)
    return [f"{each:g}" if numbers else str(each) for each in values.tolist()]


def _in_short(error: BaseException) -> str:
    try:
        text = " ".join(str(error).split())[:200].rstrip(".")
    except Exception:
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
