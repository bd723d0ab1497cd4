"""The objective of an attack: the detectors' own losses against an empty truth."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from skyproof.attacks.settings import Method
from skyproof.detectors.detector import Candidates, Detector, TrainableDetector
from skyproof.detectors.matching import CENTRE_DISTANCE_M, centres_of, contain
from skyproof.ranges import Match
from skyproof.render.frames import Frames
from skyproof.storage import weights_digest

_FOOLED = 0.03
"""At this share of the loss without camouflage, a vehicle is nearly hidden and counts little."""

OBJECTIVES: dict[Method, str] = {
    "skyproof": f"sum over detectors, mean over images: log(weight * loss + {_FOOLED:g})",
    "paper": "sum over detectors, mean over images: weight * loss",
}
"""The objective of each method as it is recorded with a camouflage."""


class Objective(NamedTuple):
    """The objective, and each detector's mean plain loss."""

    loss: float
    losses: dict[str, float]


def empty_truth_losses(
    detectors: Sequence[TrainableDetector], images: Float[Tensor, "B 3 H W"]
) -> dict[str, Float[Tensor, " B"]]:
    """Returns each detector's training loss per image as if it showed no vehicle (section 3.2)."""
    nothing = [images.new_zeros(0, 4)] * len(images)
    return {detector.name: detector.loss(images, nothing) for detector in detectors}


@torch.no_grad()
def objective(
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    images: Float[Tensor, "B 3 H W"],
    method: Method = "skyproof",
) -> Objective:
    """Measures how far detectors are from seeing nothing: the sum of their losses' logarithms.

    Objective = sum over detectors of the mean over images of log(weight * loss + 0.03), where the
    loss is the detector's own against an empty truth, and its weight makes it 1 without camouflage.
    A logarithm falls as much from 0.2 to 0.1 as from 2 to 1, so the objective asks in how many
    images a detector is nearly fooled. The paper's sum of losses, which the method "paper" has, is
    dominated by the images in which a detector is surest. Detectors are frozen, images are sRGB in
    [0, 1].
    """
    by_detector = empty_truth_losses(detectors, images)
    terms = [float(_term(method, weights[name], each)) for name, each in by_detector.items()]
    return Objective(sum(terms), {name: float(each.mean()) for name, each in by_detector.items()})


def objective_and_gradient(
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    images: Float[Tensor, "B 3 H W"],
    share: float = 1.0,
    method: Method = "skyproof",
) -> tuple[Objective, Float[Tensor, "B 3 H W"]]:
    """Returns the objective and its gradient with respect to the images, arguments as `objective`.

    Both are multiplied by the images' share of a batch. Detectors run one after the other, so that
    only one network's activations are held.
    """
    leaf = images.detach().contiguous(memory_format=torch.channels_last).requires_grad_()
    total = 0.0
    losses = {}
    for detector in detectors:
        own = empty_truth_losses([detector], leaf)[detector.name]
        term = share * _term(method, weights[detector.name], own)
        term.backward()
        total += float(term.detach())
        losses[detector.name] = share * float(own.detach().mean())
    assert leaf.grad is not None
    return Objective(total, losses), leaf.grad


def _term(method: Method, weight: float, losses: Float[Tensor, " B"]) -> Float[Tensor, ""]:
    if method == "paper":
        return weight * losses.mean()
    return (weight * losses + _FOOLED).log().mean()


def balanced_weights(losses: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Returns the weights that bring every detector's mean of these losses to 1.

    Differences from the paper: it gives numbers (table S2) for losses that partly sum over anchors.
    Ours are normalised per image, so the numbers cannot be used.
    """
    return {name: 1.0 / max(sum(values) / len(values), 1e-8) for name, values in losses.items()}


@torch.no_grad()
def target_scores(
    detector: Detector, frames: Frames, gsd_m: float, match: Match = "centre_1m"
) -> Float[Tensor, " B"]:
    """Returns the best score, of candidates or black-box detections, on each image's vehicle; or 0.

    By the main rule their centre is within 1 m, by the lenient rule there or in the vehicle's box.
    """
    candidates = _candidates(detector, frames.image.detach())
    boxes, centres = frames.boxes[:, None], centres_of(candidates.boxes)
    distance_m = (centres - centres_of(boxes)).norm(dim=-1) * gsd_m
    near = distance_m <= CENTRE_DISTANCE_M
    if match == "centre_in_box":
        near |= contain(boxes, centres)
    return candidates.scores.masked_fill(~near, 0.0).amax(1)


def _candidates(detector: Detector, images: Float[Tensor, "B 3 H W"]) -> Candidates:
    if isinstance(detector, TrainableDetector):
        return detector.candidates(images)
    found = detector.detect(images)
    # One row of padding at least, for images in which nothing is found.
    boxes = [functional.pad(each.boxes, (0, 0, 0, 1)).to(images) for each in found]
    scores = [functional.pad(each.scores, (0, 1)).to(images) for each in found]
    return Candidates(*(pad_sequence(each, batch_first=True) for each in (boxes, scores)))


@contextmanager
def frozen(detectors: Sequence[TrainableDetector]) -> Iterator[None]:
    """Holds detectors in evaluation mode and without weight gradients, and checks their weights."""
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
