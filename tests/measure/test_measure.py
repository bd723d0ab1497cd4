"""Outcomes of scenes judged by hand."""

import dataclasses
import math

import pytest
import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detector
from skyproof.measure import measure as room
from skyproof.measure.views import SceneView
from skyproof.scenes.weather import CONDITIONS


def detector(threshold=0.5):
    detector = Detector()
    detector.set_card(DetectorCard("retinanet", threshold=threshold, gsd_m=0.125))
    return detector


def view(found, truth, ignore=None, visible=None):
    """Detections and boxes per image."""
    blank = [torch.zeros(3, 1, 1, dtype=torch.uint8)] * len(truth)
    images = Dataset.of_images(blank, truth, ignore=ignore, gsd_m=0.125)
    if visible is not None:
        images = dataclasses.replace(images, visible_fractions=visible)
    return SceneView("T-U", images, {"retinanet": found})


def compare(scenes, truth, original, adversarial, *, threshold=0.5, visible=None):
    return room.compare(
        scenes,
        view(original, truth, visible=visible),
        view(adversarial, truth),
        detector(threshold),
        "torch",
        ["centre_1m"],
    )


def count_false_alarms(truth, found, *, ignore=None):
    matches = view(found, truth, ignore).matched("retinanet", "centre_1m")
    return matches.counts_at(0.5)[1]


def boxes(*centres):
    return torch.tensor([[x - 10.0, y - 10.0, x + 10.0, y + 10.0] for x, y in centres]).reshape(
        -1, 4
    )


def test_detected_score_and_distance(make_scene, make_detections):
    truth = [boxes((50, 50), (150, 50), (250, 50))]
    original = [make_detections((50, 50, 0.9), (154, 50, 0.8), (300, 300, 0.7))]
    adversarial = [make_detections((250, 50, 0.6), (150, 56, 0.3))]
    first, second, third = compare([make_scene("a", "tile", 3)], truth, original, adversarial)
    assert (first.detected_original, first.detected_adversarial) == (True, False)
    assert (first.score_adversarial, math.isnan(first.distance_adversarial_m)) == (0.0, True)
    # Below the threshold the match is kept with its score, but it is no detection.
    assert (second.detected_original, second.detected_adversarial) == (True, False)
    assert second.score_adversarial == pytest.approx(0.3)
    assert second.distance_original_m == pytest.approx(4 * 0.125)
    assert second.distance_adversarial_m == pytest.approx(6 * 0.125)
    assert (third.detected_original, third.detected_adversarial) == (False, True)
    assert (third.placement, third.vehicle, third.body_type) == (2, "pick-up-0002", "pick-up")


def test_the_limit_of_one_metre(make_scene, make_detections):
    truth = [boxes((50, 50))]
    for offset_px, found in ((8.0, True), (8.1, False)):
        outcome = compare(
            [make_scene("a", "t")],
            truth,
            [make_detections((50 + offset_px, 50, 0.9))],
            [make_detections()],
        )[0]
        assert outcome.detected_original is found


def test_a_score_on_the_threshold_counts(make_scene, make_detections):
    found = make_detections((50, 50, 0.1))
    scenes, truth, threshold = [make_scene("a", "t")], [boxes((50, 50))], float(found.scores[0])
    (outcome,) = compare(scenes, truth, [found], [found], threshold=threshold)
    assert outcome.detected_original


def test_lower_scores_never_change_a_match_at_the_threshold(make_scene, make_detections):
    generator = torch.Generator().manual_seed(3)
    for _ in range(50):
        truth = [boxes(*(torch.rand(4, 2, generator=generator) * 40).tolist())]
        table = torch.cat(
            [torch.rand(12, 2, generator=generator) * 40, torch.rand(12, 1, generator=generator)],
            dim=1,
        )
        every, strong = (
            make_detections(*table.tolist()),
            make_detections(*table[table[:, 2] >= 0.5].tolist()),
        )
        scene = [make_scene("a", "t", 4)]
        outcomes = compare(scene, truth, [every], [strong])
        assert [o.detected_original for o in outcomes] == [o.detected_adversarial for o in outcomes]


def test_conditions(make_scene, make_detections):
    scene = make_scene("a", "tile-3", heading_rad=math.radians(-45))
    outcome = compare([scene], [boxes((50, 50))], [make_detections()], [make_detections()])[0]
    assert outcome.background == "tile-3"
    assert outcome.sun_elevation_deg == pytest.approx(30)
    assert outcome.tilt_deg == pytest.approx(10)
    assert outcome.camera_azimuth_deg == pytest.approx(270)
    assert outcome.heading_deg == pytest.approx(315)
    assert outcome.heading_to_sun_deg == pytest.approx(135)
    assert math.isnan(outcome.visible_fraction)


def test_vehicles_out_of_sight_give_no_outcome(make_scene, make_detections):
    truth = [torch.cat([torch.zeros(1, 4), boxes((50, 50))])]
    near_the_corner = [make_detections((2, 2, 0.9))]
    outcomes = compare(
        [make_scene("a", "t", 2)],
        truth,
        near_the_corner,
        near_the_corner,
        visible=[torch.tensor([0.0, 0.5])],
    )
    assert [(o.placement, o.visible_fraction, o.detected_original) for o in outcomes] == [
        (1, 0.5, False)
    ]
    assert count_false_alarms(truth, near_the_corner) == 1


def test_false_alarms_are_unmatched_above_the_threshold_and_outside_ignore_regions(make_detections):
    found = make_detections(
        (50, 50, 0.9), (52, 50, 0.8), (200, 200, 0.7), (300, 300, 0.6), (350, 350, 0.4)
    )
    truth = [boxes((50, 50))]
    assert count_false_alarms(truth, [found]) == 3
    ignore = [torch.tensor([[190.0, 190.0, 210.0, 210.0]])]
    assert count_false_alarms(truth, [found], ignore=ignore) == 2


def test_the_weather_of_the_scene_is_recorded(make_scene, make_detections):
    scene = make_scene("a", "t")
    scenes = [scene, dataclasses.replace(scene, id="b", weather=CONDITIONS["low_sun"](0.5))]
    nothing = [make_detections()] * 2
    outcomes = compare(scenes, [boxes((50, 50))] * 2, nothing, nothing)
    assert [outcome.condition for outcome in outcomes] == ["clear", "low_sun"]
