"""What comes from somebody else's detector is checked, put in order, or refused in a sentence."""

from __future__ import annotations

import itertools
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from detector_images import bar_images

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.validation import validate
from skyproof.errors import ConfigurationError, DetectorAnswerError

IMAGES = torch.zeros(1, 3, 40, 60)
BOX = [10.0, 10.0, 20.0, 18.0]


class Says:
    name = "theirs"

    def __init__(self, *answers):
        self.answers = list(answers)

    def detect(self, images):
        return self.answers


class Strange:
    @property
    def boxes(self):
        return 1 / 0


def answer(boxes, scores):
    return SimpleNamespace(boxes=boxes, scores=scores)


def test_answers_are_sorted_and_cut_at_the_border():
    low, high = [-3.0, 30.0, 12.0, 44.0], [50.0, 2.0, 70.0, 9.0]
    checked = BlackBoxDetector(Says(answer([low, high], [0.2, 0.9])))
    (found,) = checked.detect(IMAGES)
    assert isinstance(found, Detections)
    assert found.scores.tolist() == pytest.approx([0.9, 0.2])
    assert found.boxes.tolist() == [[50, 2, 60, 9], [0, 30, 12, 40]]


@pytest.mark.parametrize(
    "form",
    [
        lambda boxes, scores: (boxes, scores),
        lambda boxes, scores: [boxes, scores],
        lambda boxes, scores: {"labels": [1], "boxes": boxes, "scores": scores},
        answer,
    ],
)
def test_any_callable_is_a_detector(form):
    def theirs(images):
        return [form([BOX], [0.5])] * len(images)

    asked = BlackBoxDetector(theirs)
    first, second = asked.detect(torch.cat([IMAGES, IMAGES]))
    assert first.boxes.tolist() == second.boxes.tolist() == [BOX]
    assert asked.name == "theirs"


def test_a_callable_has_a_name_that_can_be_a_files():
    assert BlackBoxDetector(lambda images: []).name == "lambda"
    assert BlackBoxDetector(partial(print), name="mine").name == "mine"
    for detector, name in [(partial(print), None), (print, "../out"), (3, "three")]:
        with pytest.raises(ConfigurationError, match="callable with a plain name") as error:
            BlackBoxDetector(detector, name)
        assert "give a function from images to boxes and scores" in str(error.value)


def test_a_callables_threshold_is_frozen_on_labelled_images():
    image, box = torch.zeros(3, 40, 60, dtype=torch.uint8), torch.tensor([BOX])
    images = Dataset.of_images([image], [box], gsd_m=0.125)
    found = load_detector(lambda images: [(box, [0.5])] * len(images), images, name="mine")
    assert (found.name, found.threshold, found.card.gsd_m) == ("mine", 0.255, 0.125)
    with pytest.raises(ConfigurationError, match="The threshold of mine is frozen on labelled"):
        load_detector(lambda images: [], None, name="mine")
    with pytest.raises(ConfigurationError, match="mine finds none of the 1 labelled vehicles"):
        load_detector(lambda images: [([], [])] * len(images), images, name="mine")


CAR, VAN, TREE = BOX, [11.0, 10.0, 21.0, 18.0], [40.0, 10.0, 50.0, 20.0]


def labelled(labels):
    return SimpleNamespace(boxes=[CAR, VAN, TREE], scores=[0.5, 0.7, 0.9], labels=labels)


@pytest.mark.parametrize(
    ("form", "classes"),
    [
        (labelled(["car", "van", "tree"]), ["car", "van"]),
        (vars(labelled(np.array([3, 8, 0]))), ["3", "8"]),
        (labelled(torch.tensor([3.0, 8.0, 0.0])), ["3", "8"]),
    ],
)
def test_labels_tell_vehicles_from_other_classes(form, classes):
    asked = BlackBoxDetector(Says(form), vehicle_classes=classes)
    # A car that may also be a van is found once.
    (found,) = asked.detect(IMAGES)
    assert (found.boxes.tolist(), found.scores.tolist()) == ([VAN], pytest.approx([0.7]))
    for checked in (asked, BlackBoxDetector(asked)):
        (others,) = checked.of_other_classes().detect(IMAGES)
        assert (others.boxes.tolist(), others.scores.tolist()) == ([TREE], pytest.approx([0.9]))
        assert checked.detect(IMAGES)[0].boxes.tolist() == [VAN]
    assert BlackBoxDetector(Says(form)).of_other_classes() is None


def test_labels_that_tell_no_vehicles_are_one_sentence():
    image, box = torch.zeros(3, 40, 60, dtype=torch.uint8), torch.tensor([BOX])
    images = Dataset.of_images([image], [box], gsd_m=0.125)
    several = Says(labelled(["car", "car", "tree"]))
    with pytest.raises(
        ConfigurationError, match=r"2 classes \(car, tree\), and nothing .* vehicle_classes"
    ):
        load_detector(several, images)
    wrong = BlackBoxDetector(several, vehicle_classes=["Car"])
    with pytest.raises(ConfigurationError, match=r"\(Car\), but with car, tree; choose"):
        wrong.freeze(images)
    for labels in ([1], 7, [[1], [2], [3]], None):
        with pytest.raises(DetectorAnswerError, match="vehicle_classes each box has one of the"):
            BlackBoxDetector(Says(labelled(labels)), vehicle_classes=["1"]).detect(IMAGES)
        BlackBoxDetector(Says(labelled(labels))).freeze(images)
    pair = BlackBoxDetector(lambda images: [([CAR], [0.5])], vehicle_classes=["1"])
    with pytest.raises(DetectorAnswerError, match="0 labels of 1 boxes"):
        pair.detect(IMAGES)


@pytest.mark.parametrize("empty", [[], torch.zeros(0), torch.zeros(0, 4)])
def test_nothing_found_is_an_answer(empty):
    (found,) = BlackBoxDetector(Says(answer(empty, []))).detect(IMAGES)
    assert found.boxes.shape == (0, 4)
    assert found.scores.shape == (0,)


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ([answer([BOX], [float("nan")])], "finite numbers, got NaN"),
        ([answer([[1.0, 2.0, float("inf"), 4.0]], [0.5])], "finite numbers, got NaN or infinity"),
        ([answer([BOX], [1.5])], "scores lie in [0, 1], got 1.5 to 1.5"),
        ([answer([BOX], [-0.1])], "scores lie in [0, 1]"),
        ([answer([[70.0, 1.0, 80.0, 5.0]], [0.5])], "image of 60 x 40 px, got one at [70.0"),
        ([answer([[5.0, -9.0, 8.0, -1.0]], [0.5])], "boxes lie in the image"),
        ([answer([[20.0, 10.0, 10.0, 18.0]], [0.5])], "right or bottom comes before"),
        ([answer([BOX], [0.5, 0.6])], "boxes are [K, 4] and scores [K], got [1, 4] and [2]"),
        ([answer([], [0.5])], "1 scores without boxes"),
        ([answer([BOX[:3]], [0.5])], "boxes are [K, 4]"),
        ([answer("none", [0.5])], "each image expects boxes and scores, got ValueError"),
        ([answer([BOX, BOX[:3]], [0.5, 0.5])], "boxes and scores, got ValueError"),
        (
            [answer(torch.tensor([BOX]).to_sparse(), [0.5])],
            "each image expects boxes and scores, got TypeError",
        ),
        ([Strange()], "each image expects boxes and scores, got ZeroDivisionError"),
        (
            [answer([[30.0, 20.0, 12.0, 6.0]], [0.5])],
            "right or bottom comes before its left or top, as if they were a width and a height;",
        ),
        (
            [answer([[0.5, 0.5, 0.2, 0.3]], [0.5])],
            "as if they were a width and a height in fractions of the image;",
        ),
        (
            [answer([[100.0, 90.0, 150.0, 99.0], BOX], [0.5, 0.4])],
            "one at [100.0, 90.0, 150.0, 99.0], as if the image were enlarged 2.5 times;",
        ),
        ([None], "each image expects boxes and scores, got AttributeError"),
        ([], "1 images expect as many answers, got 0"),
        ([answer([], []), answer([], [])], "as many answers, got 2"),
    ],
)
def test_what_cannot_be_an_answer_is_one_sentence(answers, words):
    with pytest.raises(DetectorAnswerError) as error:
        BlackBoxDetector(Says(*answers)).detect(IMAGES)
    assert words in str(error.value)
    assert str(error.value).startswith("The detector theirs gave an answer")
    assert "the same command goes on" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "form",
    [
        np.asarray,
        lambda part: np.asarray(part)[::-1][::-1],
        lambda part: np.asarray(part, dtype=np.float16),
        lambda part: list(np.asarray(part)),
        lambda part: list(torch.tensor(part)),
        lambda part: torch.tensor(part, dtype=torch.float64, requires_grad=True),
    ],
)
def test_answers_of_numpy_are_read_without_a_word(form, recwarn):
    (found,) = BlackBoxDetector(Says((form([BOX, BOX]), form([0.5, 0.25])))).detect(IMAGES)
    assert found.boxes.tolist() == [BOX, BOX]
    assert found.scores.tolist() == [0.5, 0.25]
    assert not recwarn.list


def test_whatever_leaves_its_program_is_one_sentence_but_ctrl_c_stops():
    class Lookalike(KeyboardInterrupt):
        pass

    class Mute(Exception):
        def __str__(self):
            raise ValueError

    def raises(error):
        def detect(images):
            raise error

        return BlackBoxDetector(detect)

    for error in (SystemExit(0), Lookalike(), GeneratorExit(), BaseException("gone"), Mute()):
        with pytest.raises(DetectorAnswerError, match=f"did not answer .{type(error).__name__}"):
            raises(error).detect(IMAGES)
    with pytest.raises(KeyboardInterrupt):
        raises(KeyboardInterrupt()).detect(IMAGES)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda boxes: boxes[:, [1, 0, 3, 2]], "read as top, left, bottom, right .AP 1.00"),
        (lambda boxes: boxes / 256, "read as fractions of the image's"),
        (
            lambda boxes: boxes / 30,
            r"finds none of the 19 .* \(its 19 boxes are about 0.5 x 1.2 px\), so",
        ),
    ],
)
def test_boxes_that_look_misplaced_say_what_they_look_like(change, words):
    images = bar_images(20, 256, seed=0)
    shown = iter(images.boxes)

    def theirs(batch):
        return [
            (change(boxes), [0.9] * len(boxes)) for boxes in itertools.islice(shown, len(batch))
        ]

    with pytest.raises(ConfigurationError, match=words):
        load_detector(theirs, images)


def test_what_its_program_raises_is_one_sentence():
    class Down(Says):
        def detect(self, images):
            raise ConnectionRefusedError("[Errno 111]\nConnection refused")

    with pytest.raises(
        DetectorAnswerError, match=r"ConnectionRefusedError: \[Errno 111\] Connection"
    ):
        BlackBoxDetector(Down()).detect(IMAGES)


def test_answers_are_checked_wherever_an_object_is_used():
    class Bare:
        name = "theirs"

        def __init__(self, boxes, scores):
            self.answer = answer(boxes, scores)

        def detect(self, images):
            return [self.answer] * len(images)

    small = torch.zeros(3, 40, 60, dtype=torch.uint8)
    large = torch.zeros(3, 40, 1100, dtype=torch.uint8)
    box = torch.tensor([BOX])
    dataset = Dataset.of_images([small], [box], gsd_m=0.125)
    for score in (float("nan"), 92.0):
        with pytest.raises(DetectorAnswerError, match="The detector theirs"):
            validate(BlackBoxDetector(Bare(box, [score])), dataset)
    # Boxes of double precision were no boxes to suppression.
    for image in (small, large):
        detector = BlackBoxDetector(Bare(box.double(), [0.5]))
        (found,) = detect_all(detector, Dataset.of_images([image], [box], gsd_m=1.0))
        assert found.boxes.dtype == torch.float32
    with pytest.raises(ConfigurationError, match=r"^threshold expects .* got 46"):
        DetectorCard("theirs", threshold=46.0, gsd_m=0.125)


def test_an_error_of_ours_stays_what_it_is():
    class Ours(Says):
        def detect(self, images):
            raise ConfigurationError("Other images, please.")

    with pytest.raises(ConfigurationError, match="Other images"):
        BlackBoxDetector(Ours()).detect(IMAGES)
