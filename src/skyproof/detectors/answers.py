"""Any callable as a detector, whose answers are checked: it may fail, or answer nonsense."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.validation import frozen_card
from skyproof.errors import ConfigurationError, DetectorAnswerError, SkyproofError
from skyproof.ranges import is_name

Answering = Callable[[Any], Sequence[object]]
"""A function from images to the boxes and scores of each; see `BlackBoxDetector`."""

_GO_ON = "the same command goes on where it stopped"


class BlackBoxDetector(Detector):
    """A detector known only by its detections, which are checked.

    A callable, or the method `detect` of an object, takes sRGB images `[B, 3, H, W]` in [0, 1] and
    gives boxes `[K, 4]` (left, top, right, bottom in pixels) and scores `[K]` in [0, 1] of each
    image: as a pair, or as attributes or items called `boxes` and `scores`. Its name in tables is
    that of the card, `name`, or its own `name` or `__name__`.
    """

    def __init__(
        self, detector: object, name: str | None = None, card: DetectorCard | None = None
    ) -> None:
        own = getattr(detector, "name", None) or getattr(detector, "__name__", "").strip("<>")
        self.name = own if name is None else name
        if card is not None:
            self.set_card(card)
        # The answers of another one are checked here, so once.
        wrapped = detector._detect if isinstance(detector, BlackBoxDetector) else detector
        self._detect: Any = getattr(wrapped, "detect", wrapped)
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
        self.set_card(frozen_card(self, labelled, remedy))

    @torch.no_grad()
    def detect(self, images: Float[Tensor, "B 3 H W"]) -> list[Detections]:
        """See `Detector.detect`; a DetectorAnswerError says how it failed."""
        try:
            answers = self._detect(images)
        except SkyproofError:
            raise
        except Exception as error:
            # A foreign program may raise anything.
            raise DetectorAnswerError(
                f"The detector {self.name} did not answer ({_in_short(error)}); see that it runs, "
                f"and {_GO_ON}."
            ) from error
        if not isinstance(answers, Sequence) or len(answers) != len(images):
            count = len(answers) if isinstance(answers, Sequence) else type(answers).__name__
            raise self._wrong(f"{len(images)} images expect as many answers", f"{count}")
        height_px, width_px = images.shape[-2:]
        return [self._checked(answer, width_px, height_px) for answer in answers]

    def _checked(self, answer: Any, width_px: int, height_px: int) -> Detections:
        try:
            boxes, scores = (
                torch.as_tensor(part).detach().float().cpu() for part in _parts(answer)
            )
        except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise self._wrong("each image expects boxes and scores", _in_short(error)) from error
        if scores.ndim != 1 or (tuple(boxes.shape) != (len(scores), 4) and boxes.numel()):
            shapes = f"{[*boxes.shape]} and {[*scores.shape]}"
            raise self._wrong("boxes are [K, 4] and scores [K]", shapes)
        if len(scores) and not boxes.numel():
            raise self._wrong("every score has a box", f"{len(scores)} scores without boxes")
        boxes = boxes.reshape(-1, 4)
        if not (boxes.isfinite().all() and scores.isfinite().all()):
            raise self._wrong("boxes and scores are finite numbers", "NaN or infinity")
        if len(scores) and not (scores.min() >= 0 and scores.max() <= 1):
            raise self._wrong("scores lie in [0, 1]", f"{scores.min():.4g} to {scores.max():.4g}")
        if bool((boxes[:, 2:] < boxes[:, :2]).any()):
            raise self._wrong(
                "boxes are left, top, right, bottom in pixels",
                "one whose right or bottom comes before its left or top",
            )
        limits = torch.tensor([width_px, height_px, width_px, height_px], dtype=torch.float32)
        outside = (boxes[:, :2] >= limits[:2]).any(1) | (boxes[:, 2:] <= 0).any(1)
        if bool(outside.any()):
            box = [round(value, 1) for value in boxes[outside][0].tolist()]
            raise self._wrong(
                f"boxes lie in the image of {width_px} x {height_px} px", f"one at {box}"
            )
        order = scores.argsort(descending=True, stable=True)
        return Detections(boxes[order].clamp(min=0).minimum(limits), scores[order])

    def _wrong(self, expected: str, got: str) -> DetectorAnswerError:
        return DetectorAnswerError(
            f"The detector {self.name} gave an answer that cannot be one: {expected}, got {got}; "
            f"correct it, and {_GO_ON}."
        )


def _parts(answer: Any) -> tuple[Any, Any]:
    if isinstance(answer, Mapping):
        return answer["boxes"], answer["scores"]
    if isinstance(answer, tuple | list):
        boxes, scores = answer
        return boxes, scores
    return answer.boxes, answer.scores


def _in_short(error: Exception) -> str:
    text = " ".join(str(error).split())[:200].rstrip(".")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
