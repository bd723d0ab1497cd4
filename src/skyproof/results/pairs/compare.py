"""Matched pairs to outcomes: the same scenes, seen by one detector with and without a camouflage (PAPER 9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.detectors.detector import Detections
from skyproof.detectors.matching import Criterion, Matches, match_detections
from skyproof.results.pairs.outcomes import Outcome
from skyproof.scenes.scene import Scene

__all__ = ["Comparison", "compare", "count_false_alarms"]


@dataclass(frozen=True)
class Comparison:
    """What is compared, and how detection is judged.

    Attributes:
        camouflage, renderer, detector: names, as they appear in the tables.
        match: "centre_1m" or "iou_50" (PAPER 19).
        threshold: the detector's frozen score threshold (PAPER 18).
        gsd_m: metres per pixel.
    """

    camouflage: str
    renderer: str
    detector: str
    match: Criterion
    threshold: float
    gsd_m: float


def compare(
    scenes: Sequence[Scene],
    truth_boxes: Sequence[Float[Tensor, "_ 4"]],
    original: Sequence[Detections],
    adversarial: Sequence[Detections],
    comparison: Comparison,
    *,
    adversarial_truth_boxes: Sequence[Float[Tensor, "_ 4"]] | None = None,
    visible_fractions: Sequence[Float[Tensor, " _"]] | None = None,
) -> list[Outcome]:
    """Judges every vehicle before and after; one outcome per vehicle (PAPER 18, 19, 38).

    Detections of every score are matched at once. Because matching is greedy by score, a vehicle's match at the
    frozen threshold is its match here wherever that match's score reaches the threshold.

    Args:
        scenes: B scenes.
        truth_boxes: per scene `[n, 4]` the box of each placement, pixel xyxy, in the order of `Scene.placements`.
            A placement whose box has no area is out of sight and gives no outcome.
        original, adversarial: per scene what the detector found with score >= 0.01.
        comparison: names, criterion, threshold.
        adversarial_truth_boxes: where a shape changes the vehicle's outline; default `truth_boxes`.
        visible_fractions: per scene `[n]`; nan in the outcomes where not given.

    Raises:
        ValueError: the sequences do not belong together.
    """
    after_boxes = truth_boxes if adversarial_truth_boxes is None else adversarial_truth_boxes
    lengths = {len(scenes), len(truth_boxes), len(after_boxes), len(original), len(adversarial)}
    if len(lengths) != 1:
        raise ValueError(
            f"expected one entry per scene in every sequence, got lengths {sorted(lengths)}"
        )
    outcomes: list[Outcome] = []
    for index, scene in enumerate(scenes):
        if len(truth_boxes[index]) != len(scene.placements) or len(after_boxes[index]) != len(
            scene.placements
        ):
            raise ValueError(
                f"scene {scene.id} has {len(scene.placements)} placements, but another number of boxes"
            )
        in_sight = _has_area(truth_boxes[index])
        before = _judge(original[index], truth_boxes[index][in_sight], comparison)
        after = _judge(adversarial[index], after_boxes[index][in_sight], comparison)
        visible = None if visible_fractions is None else visible_fractions[index]
        placements = in_sight.nonzero()[:, 0].tolist()
        outcomes.extend(
            _outcome(scene, placement, comparison, was, became, visible)
            for placement, was, became in zip(placements, before, after, strict=True)
        )
    return outcomes


def count_false_alarms(
    truth_boxes: Sequence[Float[Tensor, "_ 4"]],
    detections: Sequence[Detections],
    comparison: Comparison,
    *,
    ignore: Sequence[Float[Tensor, "_ 4"]] | None = None,
) -> int:
    """Detections at or above the threshold that match no vehicle and lie in no ignore region (PAPER 1, 38)."""
    count = 0
    for index, found in enumerate(detections):
        truth = truth_boxes[index][_has_area(truth_boxes[index])]
        matches = _match(found, truth, comparison, None if ignore is None else ignore[index])
        alarms = (
            (matches.truth_of_detection < 0)
            & ~matches.ignored
            & (found.scores >= comparison.threshold)
        )
        count += int(alarms.sum())
    return count


def _has_area(boxes: Float[Tensor, "n 4"]) -> Bool[Tensor, " n"]:
    return (boxes[:, 2:] > boxes[:, :2]).all(dim=1)


def _match(
    found: Detections,
    truth: Float[Tensor, "n 4"],
    comparison: Comparison,
    ignore: Float[Tensor, "m 4"] | None = None,
) -> Matches:
    return match_detections(
        found.boxes,
        found.scores,
        truth,
        criterion=comparison.match,
        gsd_m=comparison.gsd_m,
        ignore=ignore,
    )


def _judge(
    found: Detections, truth: Float[Tensor, "n 4"], comparison: Comparison
) -> list[tuple[bool, float, float]]:
    """Per vehicle: detected at the threshold, score of its match, centre distance in metres."""
    judged = []
    for box, detection in zip(
        truth, _match(found, truth, comparison).detection_of_truth.tolist(), strict=True
    ):
        if detection < 0:
            judged.append((False, 0.0, math.nan))
            continue
        # Compared as tensors: a float32 score turned into a Python float can fall on the other side of its own value.
        detected = bool(found.scores[detection] >= comparison.threshold)
        offset_px = (found.boxes[detection].view(2, 2) - box.view(2, 2)).mean(dim=0)
        distance_m = float(torch.linalg.vector_norm(offset_px)) * comparison.gsd_m
        judged.append((detected, float(found.scores[detection]), distance_m))
    return judged


def _outcome(
    scene: Scene,
    index: int,
    comparison: Comparison,
    before: tuple[bool, float, float],
    after: tuple[bool, float, float],
    visible: Tensor | None,
) -> Outcome:
    placement = scene.placements[index]
    sun_azimuth_deg = math.degrees(scene.sun.azimuth_rad) % 360
    heading_deg = math.degrees(placement.heading_rad) % 360
    turned_deg = (heading_deg - sun_azimuth_deg) % 360
    return Outcome(
        scene=scene.id,
        placement=index,
        vehicle=placement.vehicle,
        body_type=placement.vehicle.rpartition("-")[0] or placement.vehicle,
        background=scene.background.tile,
        camouflage=comparison.camouflage,
        renderer=comparison.renderer,
        detector=comparison.detector,
        match=comparison.match,
        detected_original=before[0],
        detected_adversarial=after[0],
        score_original=before[1],
        score_adversarial=after[1],
        distance_original_m=before[2],
        distance_adversarial_m=after[2],
        visible_fraction=math.nan if visible is None else float(visible[index]),
        sun_elevation_deg=math.degrees(scene.sun.elevation_rad),
        sun_azimuth_deg=sun_azimuth_deg,
        tilt_deg=math.degrees(scene.camera.tilt_rad),
        camera_azimuth_deg=math.degrees(scene.camera.azimuth_rad) % 360,
        heading_deg=heading_deg,
        heading_to_sun_deg=min(turned_deg, 360 - turned_deg),
        condition=scene.weather.condition,
    )
