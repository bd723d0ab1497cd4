"""How many places a detector's false alarms on photographs are, and what lies under some of them.

Frames of one flight show the same ground again and again, so that one mistake counts many times:
here the frames are laid over each other, and false alarms on one spot are one. And a vehicle that
is partly hidden is labelled by what is seen of it: who finds all of it has its centre elsewhere,
and is charged with a miss and a false alarm. Such labels are counted, and everything is told with
and without them.

    python tools/false_alarms.py --detectors detectors/* --frames 'kit/MOS*@0.116'

The frames are given in the order in which they were taken, as for `skyproof precheck`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor
from torchvision import ops

from skyproof.cli.frames import read_frames
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.card import read_card
from skyproof.detectors.detector import Detections
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_apart
from skyproof.detectors.matching import Criterion, match_detections, match_images

CRITERION: Criterion = "centre_1m"
SPOT_M = 2.5
"""Two false alarms nearer to each other than half a car's length are one."""
WITHIN = 0.6
"""So much of a label lies inside a detection that shows the whole vehicle."""
FEWEST_POINTS = 50
"""Frames with fewer points in common are of another place."""


@dataclass(frozen=True, kw_only=True)
class FalseAlarms:
    """Counts false alarms on annotated frames by the spot on the ground.

    Attributes:
        detectors: detector folders, all of one resolution.
        frames: annotated photographs, as for `skyproof precheck`.
        frame_classes: class names that count as vehicles.
    """

    detectors: tuple[Path, ...]
    frames: tuple[str, ...]
    frame_classes: tuple[str, ...] = ("car", "minibus")

    def run(self) -> None:
        """Prints, per set of frames and detector, what false alarms come down to."""
        gsd_m = read_card(self.detectors[0]).gsd_m
        judges = load_apart(self.detectors, torch.device("cpu"), gsd_m)
        for clean in read_frames(self.frames, self.frame_classes, gsd_m):
            grounds = registered(clean.images)
            for judge in judges:
                found = detect_all(judge.detector, clean.images)
                print(f"{clean.name}, {judge.name} at {judge.threshold:.2f}")
                _tell("as labelled", found, clean.images, judge.threshold)
                alarms = false_alarms(found, clean.images, judge.threshold, grounds)
                counts = by_spot(alarms, clean.images.gsd_m)
                most = ", ".join(map(str, counts[:5]))
                print(f"  {sum(counts)} false alarms on {len(counts)} spots; most often {most}")
                labels = sum(map(len, alarms.hidden))
                rest = without_hidden(clean.images, alarms)
                _tell(f"without {labels} labels in a false alarm", found, rest, judge.threshold)


@dataclass
class Alarms:
    """What a detector is charged with, at its frozen threshold.

    Attributes:
        spots: per false alarm where it lies, in pixels of the first frame of its place.
        places: per false alarm the number of its place.
        hidden: per frame the numbers of missed labels that lie inside a false alarm.
        around: per frame the boxes of these false alarms.
    """

    spots: list[Float[np.ndarray, 2]] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    hidden: list[list[int]] = field(default_factory=list)
    around: list[Float[Tensor, "_ 4"]] = field(default_factory=list)


def _tell(what: str, found: Sequence[Detections], images: Dataset, threshold: float) -> None:
    table = match_images(found, images, criterion=CRITERION)
    hits, others = table.counts_at(threshold)
    rates = (average_precision(table), hits / table.vehicles, hits / max(1, hits + others))
    ap, recall, precision = (f"{100 * rate:.1f}" for rate in rates)
    print(f"  {what}: AP {ap}, recall {recall}, precision {precision} %")


def registered(images: Dataset) -> list[tuple[int, Float[np.ndarray, "3 3"]]]:
    """Returns per frame the number of its place, and what maps it onto the first frame of that."""
    finder = cv2.SIFT.create(3000)
    grounds: list[tuple[int, np.ndarray]] = []
    before = None
    for picture in images.pictures:
        grey = cv2.cvtColor(picture.read().permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
        points, looks = finder.detectAndCompute(grey, None)
        step = None if before is None else _homography((points, looks), before)
        place, onto = grounds[-1] if grounds else (-1, np.eye(3))
        grounds.append((place + 1, np.eye(3)) if step is None else (place, onto @ step))
        before = (points, looks)
    return grounds


def _homography(own: tuple, other: tuple) -> Float[np.ndarray, "3 3"] | None:
    """Returns what maps a frame onto another; None where they have too little in common."""
    pairs = cv2.BFMatcher().knnMatch(own[1], other[1], k=2)
    # Lowe's test: the best match has to be clearly better than the second.
    good = [best for best, second in pairs if best.distance < 0.75 * second.distance]
    if len(good) < FEWEST_POINTS:
        return None
    here = np.array([own[0][match.queryIdx].pt for match in good], np.float32)
    there = np.array([other[0][match.trainIdx].pt for match in good], np.float32)
    homography, agreeing = cv2.findHomography(here, there, cv2.RANSAC, 3.0)
    return homography if int(agreeing.sum()) >= FEWEST_POINTS else None


def false_alarms(
    found: Sequence[Detections],
    images: Dataset,
    threshold: float,
    grounds: Sequence[tuple[int, Float[np.ndarray, "3 3"]]],
) -> Alarms:
    alarms = Alarms()
    for index, (place, onto) in enumerate(grounds):
        kept = found[index].scores >= threshold
        boxes, truth = found[index].boxes[kept], images.boxes[index]
        matches = match_detections(
            boxes,
            found[index].scores[kept],
            truth,
            criterion=CRITERION,
            gsd_m=images.gsd_m,
            ignore=images.ignore[index],
        )
        wrong = boxes[(matches.truth_of_detection < 0) & ~matches.ignored]
        for left, top, right, bottom in wrong.tolist():
            x, y, scale = onto @ np.array([(left + right) / 2, (top + bottom) / 2, 1.0])
            alarms.spots.append(np.array([x, y]) / scale)
            alarms.places.append(place)
        missed = torch.nonzero(matches.detection_of_truth < 0)[:, 0]
        within = _inside(truth[missed], wrong)
        alarms.hidden.append(missed[within.any(1)].tolist())
        alarms.around.append(wrong[within.any(0)])
    return alarms


def _inside(labels: Float[Tensor, "n 4"], boxes: Float[Tensor, "m 4"]) -> Tensor:
    """Says of which boxes each label lies mostly inside."""
    low = torch.maximum(labels[:, None, :2], boxes[None, :, :2])
    high = torch.minimum(labels[:, None, 2:], boxes[None, :, 2:])
    common = (high - low).clamp(min=0).prod(-1)
    return common > WITHIN * ops.box_area(labels)[:, None]


def by_spot(alarms: Alarms, gsd_m: float) -> list[int]:
    """Returns how many false alarms each spot has, most first."""
    spots: list[tuple[int, np.ndarray]] = []
    counts: list[int] = []
    for place, spot in zip(alarms.places, alarms.spots, strict=True):
        near = [
            number
            for number, (other, first) in enumerate(spots)
            if other == place and np.hypot(*(spot - first)) * gsd_m < SPOT_M
        ]
        if near:
            counts[near[0]] += 1
        else:
            spots.append((place, spot))
            counts.append(1)
    return sorted(counts, reverse=True)


def without_hidden(images: Dataset, alarms: Alarms) -> Dataset:
    """Ignores the labels that lie inside a false alarm, and these false alarms."""
    boxes, ignore = [], []
    for index, hidden in enumerate(alarms.hidden):
        own = images.boxes[index]
        stays = torch.ones(len(own), dtype=torch.bool)
        stays[hidden] = False
        boxes.append(own[stays])
        regions = (images.ignore[index].view(-1, 4), own[~stays], alarms.around[index])
        ignore.append(torch.cat(regions))
    return replace(images, boxes=boxes, ignore=ignore)


if __name__ == "__main__":
    tyro.cli(FalseAlarms).run()
