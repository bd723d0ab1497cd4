"""Pairs detections with vehicles: one matcher for average precision and for success rates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor
from torchvision import ops

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.errors import ConfigurationError
from skyproof.ranges import Match

CENTRE_DISTANCE_M = 1.0
MATCH_IOU = 0.5
# Detections per part: more than a detector returns for one image.
_PART = 512


class Matches(NamedTuple):
    """The pairing of one image, -1 for no partner; ignored are neither hits nor false alarms."""

    truth_of_detection: Int64[Tensor, " K"]
    detection_of_truth: Int64[Tensor, " T"]
    ignored: Bool[Tensor, " K"]


@dataclass(frozen=True)
class MatchTable:
    """A set of images with its detections and vehicles, matched by one rule.

    It leaves out detections in ignore regions, and vehicles out of sight, whose box has no area.

    The detections that count are sorted by falling score (equal ones keep their order); `hits` are
    those that found a vehicle. Vehicles are listed image by image, each with its index among the
    boxes of its image, the score of the detection that found it at any threshold (0 for none), and
    the metres between the centres of both (nan for none).
    """

    images: int
    scores: Float[np.ndarray, " K"]
    hits: Bool[np.ndarray, " K"]
    image_of_detection: Int[np.ndarray, " K"]
    image_of_vehicle: Int[np.ndarray, " T"]
    index_of_vehicle: Int[np.ndarray, " T"]
    score_of_vehicle: Float[np.ndarray, " T"]
    distance_of_vehicle_m: Float[np.ndarray, " T"]

    @property
    def vehicles(self) -> int:
        """The number of vehicles in sight."""
        return len(self.image_of_vehicle)

    def counts_at(self, threshold: float) -> tuple[int, int]:
        """Counts detections at or above a threshold that found a vehicle, and that found none."""
        kept = self.hits[self.counting_at(threshold)]
        hits = int(kept.sum())
        return hits, len(kept) - hits

    def counting_at(self, threshold: float) -> Bool[np.ndarray, " K"]:
        """Whether each detection is at or above a threshold."""
        return _reaches(self.scores, threshold)

    def found_at(self, threshold: float) -> Bool[np.ndarray, " T"]:
        """Whether a detection at or above a threshold found each vehicle."""
        # Matching is greedy by score, so a lower threshold changes no match above it.
        matched = ~np.isnan(self.distance_of_vehicle_m)
        return matched & _reaches(self.score_of_vehicle, threshold)


def match_images(
    detections: Sequence[Detections], labelled: Dataset, *, criterion: Match
) -> MatchTable:
    """Matches all images of a set by `match_detections`; reads no pixels of `labelled`."""
    if len(detections) != len(labelled):
        raise ConfigurationError(
            f"Got detections for {len(detections)} images but labels for {len(labelled)}."
        )
    # Empty parts come first, so that a set without images has arrays of the right kind, too.
    scores: list[np.ndarray] = [np.zeros(0, dtype=np.float32)]
    hits = [np.zeros(0, dtype=bool)]
    images = [np.zeros(0, dtype=np.int64)]
    vehicles: list[np.ndarray] = [np.zeros((0, 4))]
    per_image = zip(detections, labelled.boxes, labelled.ignore, strict=True)
    for image, (found, truth, ignore) in enumerate(per_image):
        boxes = found.boxes.cpu()
        image_scores = found.scores.cpu()
        in_sight = (truth[:, 2:] > truth[:, :2]).all(dim=1).nonzero()[:, 0].cpu()
        shown = truth.cpu()[in_sight]
        gsd_m = labelled.gsd_m
        matches = match_detections(
            boxes, image_scores, shown, criterion=criterion, gsd_m=gsd_m, ignore=ignore.cpu()
        )
        counted = ~matches.ignored
        scores.append(image_scores[counted].numpy())
        hits.append((matches.truth_of_detection[counted] >= 0).numpy())
        images.append(np.full(int(counted.sum()), image))
        # Each vehicle's image, index among its boxes, score and distance.
        rows = np.tile([image, 0, 0, np.nan], (len(shown), 1))
        rows[:, 1] = in_sight.numpy()
        matched = matches.detection_of_truth >= 0
        partners = matches.detection_of_truth[matched]
        rows[matched.numpy(), 2] = image_scores[partners].double().numpy()
        distance_px = torch.linalg.vector_norm(centres_of(boxes[partners] - shown[matched]), dim=1)
        rows[matched.numpy(), 3] = distance_px.double().numpy() * gsd_m
        vehicles.append(rows)
    order = np.argsort(-np.concatenate(scores).astype(np.float64), kind="stable")
    table = np.concatenate(vehicles)
    return MatchTable(
        images=len(labelled),
        scores=np.concatenate(scores)[order],
        hits=np.concatenate(hits)[order],
        image_of_detection=np.concatenate(images)[order],
        image_of_vehicle=table[:, 0].astype(np.int64),
        index_of_vehicle=table[:, 1].astype(np.int64),
        score_of_vehicle=table[:, 2].astype(np.concatenate(scores).dtype),
        distance_of_vehicle_m=table[:, 3],
    )


@torch.no_grad()
def match_detections(
    boxes: Float[Tensor, "K 4"],
    scores: Float[Tensor, " K"],
    truth: Float[Tensor, "T 4"],
    *,
    criterion: Match,
    gsd_m: float,
    ignore: Float[Tensor, "m 4"] | None = None,
) -> Matches:
    """Pairs detections with vehicles one-to-one, greedily by falling score; boxes are pixel xyxy.

    Each detection in turn takes the best free vehicle: the nearest centre within 1.0 m
    ("centre_1m"), or the largest IoU of at least 0.5 ("iou_50"). By the lenient rule
    ("centre_in_box") it takes the nearest centre among the vehicles within 1.0 m and those whose
    box holds its own centre, so that a detection of half a vehicle counts. Equal scores keep their
    order. An unmatched detection with its centre in an `ignore` region does not count.
    """
    if criterion not in get_args(Match) or not gsd_m > 0:
        raise ConfigurationError(
            f"Matching expects one of {', '.join(get_args(Match))} and gsd_m above 0, but got "
            f"{criterion} and {gsd_m}."
        )
    centres = centres_of(boxes)
    # Large images have thousands of detections, so the table of all pairs is made in parts.
    pairs: dict[int, list[tuple[float, int]]] = {}
    for start in range(0, len(boxes) if len(truth) else 0, _PART):
        part = slice(start, start + _PART)
        if criterion == "iou_50":
            cost = -ops.box_iou(boxes[part].double(), truth.double())
            limit = -MATCH_IOU
        else:
            cost = torch.cdist(centres[part].double(), centres_of(truth).double()) * gsd_m
            limit = CENTRE_DISTANCE_M
        # Rounding must not decide at the limit.
        enough = cost <= limit + 1e-9
        if criterion == "centre_in_box":
            enough |= contain(truth, centres[part][:, None])
        near = torch.nonzero(enough)
        costs = cost[near[:, 0], near[:, 1]].tolist()
        for (detection, vehicle), value in zip(near.tolist(), costs, strict=True):
            pairs.setdefault(start + detection, []).append((value, vehicle))
    # Detections choose one after the other.
    truth_of_detection = torch.full((len(boxes),), -1, dtype=torch.int64)
    detection_of_truth = torch.full((len(truth),), -1, dtype=torch.int64)
    taken = set[int]()
    order = torch.argsort(scores, descending=True, stable=True).tolist() if pairs else []
    for detection in order:
        free = [pair for pair in pairs.get(detection, ()) if pair[1] not in taken]
        if free:
            best = min(free)[1]
            taken.add(best)
            truth_of_detection[detection] = best
            detection_of_truth[best] = detection
    ignored = torch.zeros(len(boxes), dtype=torch.bool)
    if ignore is not None and len(ignore):
        ignored = contain(ignore, centres[:, None]).any(dim=1) & (truth_of_detection < 0)
    return Matches(truth_of_detection, detection_of_truth, ignored)


def _reaches(scores: Float[np.ndarray, " n"], threshold: float) -> Bool[np.ndarray, " n"]:
    # The comparison keeps the scores' precision: as a Python float, a score can fall on the other
    # side of its own value.
    return np.asarray(scores >= scores.dtype.type(threshold))


def contain(boxes: Float[Tensor, "*#b 4"], points: Float[Tensor, "*#b 2"]) -> Bool[Tensor, "*b"]:
    """Says which boxes (xyxy) hold which points; leading axes are broadcast."""
    return ((points >= boxes[..., :2]) & (points < boxes[..., 2:])).all(dim=-1)


def centres_of(boxes: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 2"]:
    """The centres of boxes (xyxy)."""
    return (boxes[..., :2] + boxes[..., 2:]) / 2
