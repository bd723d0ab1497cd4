"""What an attack minimises: the detectors' own losses against an empty truth (PAPER 21-24)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.names import base_name
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.weights import weights_digest
from skyproof.errors import ConfigurationError

__all__ = ["balanced_weights", "empty_truth_losses", "frozen", "paper_weights"]

_PAPER_ORDER = ("retinanet", "faster_rcnn", "yolov5")
_PAPER_WEIGHTS = {
    **dict.fromkeys(("T-U", "T-Ma", "T-Pix", "T-PixMa", "T-Lc", "T-PixLc"), (0.020, 10.0, 10.0)),
    **dict.fromkeys(("T-Fc", "T-PixFc"), (0.002, 10.0, 2.5)),
    "T-LcMa": (0.007, 10.0, 5.0),
    "T-FcMa": (0.002, 10.0, 2.0),
    "T-PixLcMa": (0.020, 10.0, 5.0),
    "T-PixFcMa": (0.003, 10.0, 2.0),
    "S-O": (0.020, 15.0, 32.0),
    **dict.fromkeys(("C-Fc-seq", "C-Fc-par"), (0.020, 10.0, 30.0)),
    "C-PixFc-seq": (0.013, 18.740, 20.444),
    "C-PixFc-par": (0.011, 13.180, 20.860),
}


def empty_truth_losses(
    detectors: Sequence[TrainableDetector], images: Float[Tensor, "B 3 H W"]
) -> dict[str, Float[Tensor, " B"]]:
    """Each detector's training loss per image if there were no vehicle: small when nothing is detected (PAPER 21)."""
    nothing = [images.new_zeros(0, 4)] * len(images)
    return {detector.name: detector.loss(images, nothing) for detector in detectors}


def balanced_weights(first_losses: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Weights that bring every detector's first losses to 1 (PAPER 24)."""
    return {
        name: 1.0 / max(sum(values) / len(values), 1e-8) for name, values in first_losses.items()
    }


def paper_weights(camouflage: str, detectors: Sequence[str]) -> dict[str, float]:
    """The paper's own weights λ of RetinaNet, Faster R-CNN and YOLOv5 for one of its attacks (PAPER 24).

    Differences from the paper: our losses are normalised per image (PAPER 22), theirs partly sum over anchors, so that
    equal weights do not balance alike.

    Args:
        camouflage: its name; magnitude, variant and repeat do not matter.
        detectors: names; all three, in any order.

    Raises:
        ConfigurationError: another ensemble, or an attack for which the paper gives no weights.
    """
    base = base_name(camouflage).partition("@")[0]
    if base not in _PAPER_WEIGHTS or sorted(detectors) != sorted(_PAPER_ORDER):
        raise ConfigurationError(
            f"The paper gives weights for {', '.join(_PAPER_WEIGHTS)} on {', '.join(_PAPER_ORDER)} together, not for "
            f"{base} on {', '.join(detectors)}; use balanced weights."
        )
    return dict(zip(_PAPER_ORDER, _PAPER_WEIGHTS[base], strict=True))


@contextmanager
def frozen(detectors: Sequence[TrainableDetector]) -> Iterator[None]:
    """Detectors in evaluation mode and without weight gradients; checks that nothing in them changed (PAPER 23).

    Raises:
        RuntimeError: a weight or buffer differs after the block: the attack would not be one on the stored detector.
    """
    before = [weights_digest(detector) for detector in detectors]
    for detector in detectors:
        detector.eval().requires_grad_(False)
    with torch.enable_grad():
        yield
    for detector, digest in zip(detectors, before, strict=True):
        if weights_digest(detector) != digest:
            raise RuntimeError(
                f"the weights or buffers of {detector.name} changed during the attack"
            )
