"""What an attack minimises, the detectors' own losses against an empty truth, and its aim."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.detectors.detector import Candidates, Detector, TrainableDetector
from skyproof.detectors.weights import weights_digest
from skyproof.render.frames import Frames

__all__ = [
    "balanced_weights",
    "empty_truth_losses",
    "frozen",
    "loss_and_gradient",
    "target_scores",
]

_NEAR_M = 1.0


def empty_truth_losses(
    detectors: Sequence[TrainableDetector], images: Float[Tensor, "B 3 H W"]
) -> dict[str, Float[Tensor, " B"]]:
    """Gives each detector's training loss per image if there were no vehicle (section 3.2).

    It is small when nothing is detected.
    """
    nothing = [images.new_zeros(0, 4)] * len(images)
    return {detector.name: detector.loss(images, nothing) for detector in detectors}


def loss_and_gradient(
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    images: Float[Tensor, "B 3 H W"],
) -> tuple[dict[str, float], Float[Tensor, "B 3 H W"]]:
    """Adds up the detectors' weighted losses, and says how the sum changes with the images.

    Loss = sum over detectors of weight * mean over images of the detector's own loss against an
    empty truth. One detector is asked at a time, so that only one network's activations are held.

    Args:
        detectors: frozen.
        weights: of each detector's loss, by name.
        images: sRGB in [0, 1]; what they were rendered from is left alone.

    Returns:
        Every detector's mean loss, without its weight; and the gradient of the sum.
    """
    leaf = images.detach().contiguous(memory_format=torch.channels_last).requires_grad_()
    losses = {}
    for detector in detectors:
        loss = empty_truth_losses([detector], leaf)[detector.name].mean()
        (weights[detector.name] * loss).backward()
        losses[detector.name] = float(loss.detach())
    assert leaf.grad is not None
    return losses, leaf.grad


def balanced_weights(losses: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Gives the weights that bring every detector's mean of these losses to 1.

    Differences from the paper: its weights were chosen by hand for losses that partly sum over
    anchors (table S2); ours are normalised per image, so that those would not balance them.
    """
    return {name: 1.0 / max(sum(values) / len(values), 1e-8) for name, values in losses.items()}


@torch.no_grad()
def target_scores(
    detector: Detector | TrainableDetector, frames: Frames, gsd_m: float
) -> Float[Tensor, " B"]:
    """Gives the highest score of a candidate near the image's one vehicle; 0 without one.

    Near means that the candidate's centre lies within 1 m of the vehicle's. Of a detector that only
    answers, its detections are the candidates.
    """
    candidates = _candidates(detector, frames.image.detach())
    centres = (frames.boxes[:, :2] + frames.boxes[:, 2:]) / 2
    candidate_centres = (candidates.boxes[..., :2] + candidates.boxes[..., 2:]) / 2
    distance_m = (candidate_centres - centres[:, None]).norm(dim=-1) * gsd_m
    near = candidates.valid & (distance_m <= _NEAR_M)
    return candidates.scores.masked_fill(~near, 0.0).amax(1)


def _candidates(
    detector: Detector | TrainableDetector, images: Float[Tensor, "B 3 H W"]
) -> Candidates:
    if isinstance(detector, TrainableDetector):
        return detector.candidates(images)
    found = detector.detect(images)
    # One row of padding at least, for images in which nothing is found.
    rows = 1 + max(len(each.scores) for each in found)
    boxes = images.new_zeros(len(images), rows, 4)
    scores = images.new_zeros(len(images), rows)
    for number, each in enumerate(found):
        boxes[number, : len(each.boxes)] = each.boxes
        scores[number, : len(each.scores)] = each.scores
    return Candidates(boxes, scores, scores > 0)


@contextmanager
def frozen(detectors: Sequence[TrainableDetector]) -> Iterator[None]:
    """Holds detectors in evaluation mode and without weight gradients.

    Checks at the end that nothing in them changed.

    Raises:
        RuntimeError: a weight or buffer differs after the block: the attack would not be one on
            the stored detector.
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
