"""Untrained detectors by name and size."""

import torch

from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.settings import DETECTOR_NAMES
from skyproof.errors import ConfigurationError


def build_detector(name: str, size: str, *, generator: torch.Generator) -> TrainableDetector:
    """Builds an untrained detector on the CPU; its initial weights depend on `generator` alone.

    `size` is "slim" (about 1 to 2.5 M parameters, for a CPU) or "full" (9 to 43 M, for a GPU).

    Raises:
        ConfigurationError: another name or size, or the yolo extra is missing.
    """
    seed = int(torch.randint(2**62, (1,), generator=generator))
    # The libraries draw initial weights from torch's global generator: it is lent a seed here and
    # gets its state back.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return _build(name, size)


def _build(name: str, size: str) -> TrainableDetector:
    # A late import, so that matching and average precision do not load the networks.
    if name == "yolov5":
        from skyproof.detectors.ultralytics_detectors import YoloV5Detector

        return YoloV5Detector(size)
    if name == "yolov5_anchors":
        from skyproof.detectors.anchor_detector import AnchorDetector, trainable_architecture

        return AnchorDetector(trainable_architecture(size), [0], size)
    if name not in DETECTOR_NAMES:
        raise ConfigurationError(
            f"{name[:100]!r} is no detector; choose from {', '.join(DETECTOR_NAMES)}."
        )
    from skyproof.detectors.torchvision_detectors import FasterRcnnDetector, RetinaNetDetector

    return RetinaNetDetector(size) if name == "retinanet" else FasterRcnnDetector(size)
