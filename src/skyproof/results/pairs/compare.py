"""Makes outcomes of matched pairs.

A pair is the same scene as one detector sees it with and without a camouflage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from skyproof.detectors.matching import MatchTable
from skyproof.results.pairs.outcomes import Outcome
from skyproof.scenes.scene import Scene


@dataclass(frozen=True)
class Comparison:
    """What is compared, and from which score on a detection counts.

    Attributes:
        camouflage, renderer, detector: names, as they appear in the tables.
        threshold: the detector's frozen score threshold.
    """

    camouflage: str
    renderer: str
    detector: str
    threshold: float


@dataclass(frozen=True)
class _Judged:
    """What one detector made of one vehicle in one image."""

    detected: bool = False
    score: float = 0.0
    distance_m: float = math.nan


def compare(
    scenes: Sequence[Scene],
    original: MatchTable,
    adversarial: MatchTable,
    comparison: Comparison,
    *,
    visible_fractions: Sequence[Float[np.ndarray, " _"]] | None = None,
) -> list[Outcome]:
    """Judges every vehicle before and after; one outcome per vehicle.

    A placement that is out of sight in the original image gives no outcome.

    Args:
        scenes: B scenes.
        original, adversarial: the B images without and with the camouflage, matched by one rule;
            the vehicles of an image in the order of `Scene.placements`.
        comparison: names and threshold.
        visible_fractions: per scene `[n]`; nan in the outcomes where not given.

    Raises:
        ValueError: the tables do not belong to the scenes, or not to each other.
    """
    if not len(scenes) == original.images == adversarial.images:
        raise ValueError(
            f"expected one image per scene, got {len(scenes)} scenes and "
            f"{original.images} and {adversarial.images} images"
        )
    if original.criterion != adversarial.criterion:
        raise ValueError(f"matched by {original.criterion} and by {adversarial.criterion}")
    after = _judged(adversarial, comparison.threshold)
    outcomes = []
    for (image, index), before in _judged(original, comparison.threshold).items():
        scene = scenes[image]
        if index >= len(scene.placements):
            raise ValueError(
                f"scene {scene.id} has {len(scene.placements)} placements, but more vehicles"
            )
        visible = math.nan if visible_fractions is None else float(visible_fractions[image][index])
        outcomes.append(
            _outcome(
                scene,
                index,
                comparison,
                original.criterion,
                before,
                after.get((image, index), _Judged()),
                visible,
            )
        )
    return outcomes


def _judged(matches: MatchTable, threshold: float) -> dict[tuple[int, int], _Judged]:
    """Gives what became of every vehicle, by image and place in it, in this order."""
    places = zip(matches.image_of_vehicle.tolist(), matches.index_of_vehicle.tolist(), strict=True)
    columns = zip(
        matches.found_at(threshold).tolist(),
        matches.score_of_vehicle.tolist(),
        matches.distance_of_vehicle_m.tolist(),
        strict=True,
    )
    return {place: _Judged(*values) for place, values in zip(places, columns, strict=True)}


def _outcome(
    scene: Scene,
    index: int,
    comparison: Comparison,
    match: str,
    before: _Judged,
    after: _Judged,
    visible_fraction: float,
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
        match=match,
        detected_original=before.detected,
        detected_adversarial=after.detected,
        score_original=before.score,
        score_adversarial=after.score,
        distance_original_m=before.distance_m,
        distance_adversarial_m=after.distance_m,
        visible_fraction=visible_fraction,
        sun_elevation_deg=math.degrees(scene.sun.elevation_rad),
        sun_azimuth_deg=sun_azimuth_deg,
        tilt_deg=math.degrees(scene.camera.tilt_rad),
        camera_azimuth_deg=math.degrees(scene.camera.azimuth_rad) % 360,
        heading_deg=heading_deg,
        heading_to_sun_deg=min(turned_deg, 360 - turned_deg),
        condition=scene.weather.condition,
    )
