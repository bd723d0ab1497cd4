"""Average precision under resampling is compared with that of images really repeated.

Simulations say whether its intervals hold the truth.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.detectors.matching import match_images
from skyproof.detectors.validation import average_precision
from skyproof.measure import baseline as clean
from skyproof.measure.views import SceneView
from tests.measure.world import judging


def fabricate(images, *, seed, found=0.8, alarms=3, vehicles=6, places=None):
    """Makes random vehicles, some found at random scores, and false alarms.

    Some detections lie in an ignore region.
    """
    rng = np.random.default_rng(seed)
    detections, boxes = [], []
    for index in range(images):
        here = found[places[index]] if isinstance(found, dict) else found
        centres = np.stack([np.arange(vehicles) * 40 + 20, rng.uniform(20, 380, vehicles)], 1)
        seen = centres[rng.random(vehicles) < here] + rng.uniform(-3, 3, (1, 2))
        wrong = rng.uniform(20, 380, (rng.poisson(alarms), 2)) + np.array([0, 500])
        middle = np.concatenate([seen, wrong])
        scores = np.concatenate([rng.beta(5, 2, len(seen)), rng.beta(2, 5, len(wrong))])
        detections.append(Detections(around(middle), torch.tensor(scores, dtype=torch.float32)))
        boxes.append(around(centres))
    ignore = [torch.tensor([[0.0, 500.0, 100.0, 900.0]])] * images
    names = [f"image-{index}" for index in range(images)]
    return detections, Dataset.of_images(
        [torch.zeros(3, 1, 1, dtype=torch.uint8)] * images,
        boxes,
        gsd_m=0.125,
        ignore=ignore,
        ids=names,
    )


def ap_of(detections, labelled, criterion="centre_1m"):
    return average_precision(match_images(detections, labelled, criterion=criterion))


def ap_interval(detections, labelled, clusters, *, criterion, generator, replicates=1000):
    matches = match_images(detections, labelled, criterion=criterion)
    found = clean.ap_interval(matches, clusters, generator=generator, replicates=replicates)
    return found.estimate, found.low, found.high


def around(centres):
    centres = torch.tensor(np.asarray(centres), dtype=torch.float32).reshape(-1, 2)
    return torch.cat([centres - 9, centres + 9], 1)


def take(detections, labelled, indices):
    return [detections[i] for i in indices], Dataset.of_images(
        [labelled.image(i) for i in indices],
        [labelled.boxes[i] for i in indices],
        gsd_m=labelled.gsd_m,
        ignore=[labelled.ignore[i] for i in indices],
        ids=[labelled.ids[i] for i in indices],
    )


@pytest.mark.parametrize("criterion", ["centre_1m", "iou_50"])
def test_weights_mean_repeated_images(criterion):
    detections, labelled = fabricate(5, seed=1)
    clusters = [0, 1, 1, 2, 3]
    matches = match_images(detections, labelled, criterion=criterion)
    for weights in ([1, 1, 1, 1], [0, 2, 0, 1], [3, 0, 1, 0], [0, 0, 0, 4]):
        images = [i for i, cluster in enumerate(clusters) for _ in range(weights[cluster])]
        expected = ap_of(*take(detections, labelled, images), criterion)
        weighted = average_precision(matches, np.array(weights)[clusters])
        assert weighted == pytest.approx(expected, abs=1e-12)


def test_the_estimate_is_the_average_precision_and_lies_in_its_interval():
    detections, labelled = fabricate(12, seed=2)
    ap, low, high = ap_interval(
        detections,
        labelled,
        list(labelled.ids),
        criterion="centre_1m",
        generator=np.random.default_rng(0),
    )
    assert ap == pytest.approx(ap_of(detections, labelled), abs=1e-12)
    assert 0 <= low < ap < high <= 1
    again = ap_interval(
        detections,
        labelled,
        list(labelled.ids),
        criterion="centre_1m",
        generator=np.random.default_rng(0),
    )
    assert again == (ap, low, high)


def test_boxes_beside_their_vehicles_are_found_by_the_lenient_rule():
    """Ten vehicles of 5 m: six boxes fit, three are 1.5 m off along the vehicle, one is missing."""
    lefts = torch.arange(10.0) * 100
    truth = torch.stack([lefts, lefts * 0, lefts + 40, lefts * 0 + 16], dim=1)
    shift_px = torch.tensor([0.0] * 6 + [12.0] * 3)[:, None] * torch.tensor([1, 0, 1, 0])
    found = Detections(truth[:9] + shift_px, torch.linspace(0.9, 0.6, 9))
    image = torch.zeros(3, 1, 1, dtype=torch.uint8)
    images = Dataset.of_images([image], [truth], gsd_m=0.125)
    toy = judging(SimpleNamespace(name="toy", detect=lambda images: []))
    view = SceneView("town", images, {"toy": [found]})
    (row,) = clean.measure_baselines(
        [toy], clean.BaselineSet("town", images, real=True), view, seed=0
    )
    assert row.recall.estimate == 0.6
    assert row.recall_centre_in_box == 0.9
    assert row.ap_centre_1m.estimate == pytest.approx(61 / 101)
    assert row.ap_centre_in_box == pytest.approx(91 / 101)
    assert row.leniently == "by the lenient rule AP 90\u202f% and recall 90\u202f%"


def test_places_that_differ_make_it_wider_than_their_images():
    places = ["town", "town", "wood", "wood", "farm", "farm"] * 4
    detections, labelled = fabricate(
        24, seed=3, found={"town": 0.95, "wood": 0.4, "farm": 0.8}, places=places
    )
    widths = []
    for clusters in (list(labelled.ids), places):
        _, low, high = ap_interval(
            detections,
            labelled,
            clusters,
            criterion="centre_1m",
            generator=np.random.default_rng(0),
            replicates=300,
        )
        widths.append(high - low)
    assert widths[1] > 2 * widths[0]


def test_intervals_hold_the_truth():
    # The truth is the AP of a great many images; each run sees 20 places of 2 images.
    detections, labelled = fabricate(2000, seed=4)
    truth = ap_of(detections, labelled)
    held = 0
    for run in range(50):
        part = take(detections, labelled, range(40 * run, 40 * run + 40))
        clusters = [str(index // 2) for index in range(40)]
        _, low, high = ap_interval(
            *part,
            clusters,
            criterion="centre_1m",
            generator=np.random.default_rng(run),
            replicates=200,
        )
        held += low <= truth <= high
    assert held >= 45


def test_undefined_limits():
    detections, labelled = fabricate(3, seed=5)
    ap, low, high = ap_interval(
        detections, labelled, ["a"] * 3, criterion="centre_1m", generator=np.random.default_rng(0)
    )
    assert 0 < ap < 1
    assert math.isnan(low)
    assert math.isnan(high)
    empty = fabricate(3, seed=5, vehicles=0)
    answer = ap_interval(
        *empty, ["a", "b", "c"], criterion="centre_1m", generator=np.random.default_rng(0)
    )
    assert all(map(math.isnan, answer))
