"""Our components by MAITE's own checks, and in MAITE's own tasks."""

from __future__ import annotations

import importlib.metadata
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from maite.protocols import object_detection as od
from maite.spotcheck import SpotcheckError, spotcheck, spotcheck_component
from maite.tasks import evaluate, predict

import skyproof as sp
from skyproof.assessment.command import Request
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ConfigurationError, DetectorAnswerError, StoredFileError
from skyproof.maite import (
    CamouflageAugmentation,
    DetectorModel,
    HiddenVehicles,
    ModelDetector,
    Target,
    VehicleDataset,
)
from skyproof.render.dataset import render_dataset
from skyproof.render.settings import RenderSettings
from skyproof.results.statistics.intervals import overall_attack_success_rate
from skyproof.scenes.light import Light
from skyproof.vehicles.fleet import Fleet
from tests.maite.conftest import Folders
from tests.results.counted import count_outcomes


def test_spotcheck_finds_no_fault(folders: Folders, model: DetectorModel) -> None:
    dataset = spotcheck_component(od.FieldwiseDataset)(VehicleDataset(folders.original))
    checked = spotcheck_component(od.Model)(model)
    metric = spotcheck_component(od.Metric)(HiddenVehicles(model, dataset))
    augmentation = spotcheck_component(od.Augmentation)(folders.augmentation())
    images, targets, metadata = zip(*(dataset[index] for index in range(2)), strict=True)
    changed = augmentation((list(images), list(targets), list(metadata)))
    metric.update(checked(changed[0]), changed[1], changed[2])
    assert metric.compute()["found_before"] > 0
    assert dataset.get_target(1).boxes.shape == targets[1].boxes.shape


def test_spotcheck_would_find_one() -> None:
    class Wrong:
        metadata: ClassVar = {"id": "wrong"}

        def __call__(self, batch_input: Any, /) -> list[SimpleNamespace]:
            boxes, labels, scores = np.zeros((2, 4)), np.zeros(2), np.zeros(1)
            return [SimpleNamespace(boxes=boxes, labels=labels, scores=scores)] * len(batch_input)

    with pytest.raises(SpotcheckError):
        spotcheck_component(od.Model)(Wrong())([np.zeros((3, 8, 8), dtype=np.uint8)])


def test_maite_evaluates_a_camouflage(folders: Folders, model: DetectorModel) -> None:
    dataset = VehicleDataset(folders.original)
    metric = HiddenVehicles(model, dataset)
    told, _, data = spotcheck(ai_problem="object_detection")(evaluate)(
        model=model,
        dataset=dataset,
        augmentation=folders.augmentation(),
        metric=metric,
        batch_size=4,
        return_augmented_data=True,
    )
    # The same as `skyproof render` and then MAITE's predictions on that folder.
    rendered = VehicleDataset(folders.camouflaged)
    other = HiddenVehicles(model, dataset)
    predictions, _ = predict(model=model, dataset=rendered, batch_size=3)
    for start, batch in zip((0, 3), predictions, strict=True):
        some = [rendered[index] for index in range(start, start + 3)]
        other.update(batch, [each[1] for each in some], [each[2] for each in some])
    assert told == other.compute()
    drawn = [image for images, _, _ in data for image in images]
    assert all(np.array_equal(drawn[index], rendered.get_input(index)) for index in range(6))
    assert not np.array_equal(drawn[0], dataset.get_input(0))
    assert {known["camouflage"] for _, _, metadata in data for known in metadata} == {"R-U"}


def test_the_metric_counts_as_our_tables_do(folders: Folders, model: DetectorModel) -> None:
    judge = load_detector("retinanet")
    outcomes = sp.measure(
        [judge],
        sp.Dataset.open(folders.original).scenes,
        {"R-U-0": sp.load_camouflage(folders.camouflage)},
        fleet=sp.Fleet.load(folders.fleet),
        renderer=sp.TorchRenderer(sp.BackgroundSet.open(folders.ground)),
    )
    series = count_outcomes(outcomes).series
    (counts,) = (value.sum(0) for key, value in series.items() if key.match == "centre_1m")
    dataset, rendered = VehicleDataset(folders.original), VehicleDataset(folders.camouflaged)
    metric = HiddenVehicles(model, dataset)
    predictions, _ = predict(model=model, dataset=rendered, batch_size=6)
    data = [rendered[index] for index in range(6)]
    metric.update(predictions[0], [each[1] for each in data], [each[2] for each in data])
    told = metric.compute()
    assert told["found_before"] == counts[1] + counts[2] > 4
    assert (told["hidden"], told["found_only_since"]) == (counts[2], counts[3])
    assert told["easr"] == pytest.approx(overall_attack_success_rate(counts[1:]))
    assert told["vehicles"] == counts[0]
    assert 0 <= told["asr_low"] <= told["asr"] <= told["asr_high"] <= 1
    metric.reset()
    blind = [Target.of(torch.zeros(0, 4)) for _ in data]
    metric.update(blind, [each[1] for each in data], [each[2] for each in data])
    assert metric.compute()["easr"] == 1
    assert metric.compute()["easr_low"] < 1


def test_the_dataset_reads_pixels_when_asked(folders: Folders) -> None:
    dataset = VehicleDataset(folders.original)
    image, target, metadata = dataset[0]
    assert image.shape == (3, 160, 160)
    assert image.dtype == np.uint8
    assert metadata["img_gsd"] == 0.125
    assert len(metadata["vehicles"]) == len(target.boxes) == len(metadata["placements"])
    assert (target.scores == 1).all()
    assert dataset.metadata["id"] != VehicleDataset(folders.camouflaged).metadata["id"]
    with pytest.raises(IndexError):
        dataset[6]
    (folders.camouflaged / "images").rename(folders.camouflaged / "gone")
    try:
        lazy = VehicleDataset(folders.camouflaged)
        assert len(lazy.get_target(2).boxes)
        with pytest.raises(StoredFileError):
            lazy.get_input(2)
    finally:
        (folders.camouflaged / "gone").rename(folders.camouflaged / "images")


def test_images_of_several_sizes_and_ranges(folders: Folders, model: DetectorModel) -> None:
    image = VehicleDataset(folders.original).get_input(0)
    whole, floats, wide = model(
        [image, image / np.float32(255), np.pad(image, ((0, 0), (0, 32), (0, 64)))]
    )
    assert np.array_equal(whole.boxes, floats.boxes)
    assert (wide.scores[:2] > 0.5).all()
    with pytest.raises(ConfigurationError, match="floats are sRGB from 0 to 1"):
        model([image.astype(np.float32)])
    with pytest.raises(ConfigurationError, match="channels first"):
        model([image.transpose(1, 2, 0)])


def test_a_camouflage_is_no_patch_for_anybodys_images(folders: Folders) -> None:
    augmentation = folders.augmentation()
    image, target, metadata = VehicleDataset(folders.original)[0]
    for batch in (
        ([image], [target], [{**metadata, "id": "elsewhere"}]),
        ([image[:, :80]], [target], [metadata]),
    ):
        with pytest.raises(ConfigurationError, match="none of them"):
            augmentation(batch)


def answer(boxes: list[list[float]], labels: list[int], scores: list[float]) -> Target:
    return Target(
        np.array(boxes, dtype=np.float32).reshape(-1, 4),
        np.array(labels, dtype=np.int64),
        np.array(scores, dtype=np.float32),
    )


class OneImage:
    """A MAITE dataset of an image with a car, a person in it and another car."""

    truth = answer([[10, 10, 40, 24], [24, 14, 30, 20], [60, 60, 90, 74]], [2, 0, 2], [1, 1, 1])
    known: ClassVar = {"id": "a", "img_gsd": 0.125}

    def __init__(self, classes: dict[int, str]) -> None:
        self.metadata = {"id": "one image", "index2label": classes}

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> tuple[np.ndarray, Target, dict[str, Any]]:
        return np.zeros((3, 96, 96), dtype=np.uint8), self.truth, self.known


class SaysAlways:
    """A MAITE model that finds both cars of `OneImage`, one of them as a van, too."""

    found = answer(
        [[10, 10, 40, 24], [11, 10, 41, 24], [60, 60, 90, 74]], [2, 3, 2], [0.9, 0.8, 0.7]
    )

    def __init__(self, **more: Any) -> None:
        self.metadata = {"id": "always", "threshold": 0.5, **more}

    def __call__(self, batch: Any) -> list[Target]:
        return [self.found] * len(batch)


def test_other_labels_than_vehicles_are_no_vehicles() -> None:
    several = {0: "person", 2: "car", 3: "van"}
    for classes in (several, {}):
        metric = HiddenVehicles(SaysAlways(), OneImage(classes), labels=(2, 3))
        seen = answer([[10, 10, 40, 24]], [2], [0.9])
        metric.update([seen], [OneImage.truth], [OneImage.known])
        told = metric.compute()
        assert (told["vehicles"], told["found_before"], told["hidden"]) == (2, 2, 1)
        assert told["asr"] == told["easr"] == 0.5
    # The model's number of a car is not that of a dataset that knows vehicles alone.
    assert len(HiddenVehicles(SaysAlways(), OneImage({0: "vehicle"}), labels=(2,))._before) == 3
    with pytest.raises(ConfigurationError, match="the dataset's boxes have 0, 2; give"):
        HiddenVehicles(SaysAlways(), OneImage(several), labels=(3,))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (answer([[10, 10, 40, 24]], [2], [2.0]), r"scores lie in \[0, 1\], got 2 to 2"),
        (answer([[10, 10, 40, 24]], [2], [-0.5]), r"scores lie in \[0, 1\], got -0.5"),
        (answer([[10, 10, 40, 24]], [2], [np.nan]), "finite numbers, got NaN"),
        (answer([[10, np.nan, 40, 24]], [2], [0.9]), "finite numbers, got NaN"),
        (answer([[40, 24, 10, 10]], [2], [0.9]), "right or bottom comes before"),
        (answer([[210, 10, 240, 24]], [2], [0.9]), "boxes lie in the image of 96 x 96 px"),
        (
            SimpleNamespace(boxes=[[10, 10, 40, 24]], labels=[2], scores=[0.9, 0.8]),
            "1 boxes with scores of shape",
        ),
        (None, "no attribute 'boxes'"),
    ],
)
def test_the_metric_takes_no_answer_that_cannot_be_one(found: Any, words: str) -> None:
    metric = HiddenVehicles(SaysAlways(), OneImage({}), labels=(2,))
    with pytest.raises(DetectorAnswerError, match=f"always gave an answer .*{words}"):
        metric.update([found], [OneImage.truth], [OneImage.known])
    with pytest.raises(DetectorAnswerError, match="1 images expect as many answers, got 2"):
        metric.update([SaysAlways.found] * 2, [OneImage.truth], [OneImage.known])
    # What was refused was not counted as hidden.
    assert metric.compute()["hidden"] == 0

    class Broken(SaysAlways):
        def __call__(self, batch: Any) -> list[Target]:
            return [found] * len(batch)

    with pytest.raises(DetectorAnswerError, match=words):
        HiddenVehicles(Broken(), OneImage({}), labels=(2,))


@pytest.mark.parametrize("threshold", [float("nan"), 1.5, -1, "0.5"])
def test_a_threshold_that_is_none_is_refused(threshold: Any) -> None:
    with pytest.raises(ConfigurationError, match="threshold expects a number from 0 up to 1, got"):
        HiddenVehicles(SaysAlways(), OneImage({}), threshold=threshold, labels=(2,))


def test_vehicles_that_cannot_be_told_apart_are_refused() -> None:
    metric = HiddenVehicles(SaysAlways(), OneImage({}), labels=(2,))
    fewer = answer([[60, 60, 90, 74]], [2], [1])
    for more in ({}, {"placements": [0, 1, 2]}):
        metric.reset()
        with pytest.raises(ConfigurationError, match="1 boxes of 3 vehicles"):
            metric.update([fewer], [fewer], [{**OneImage.known, **more}])


def test_another_resolution_than_the_models_is_refused() -> None:
    with pytest.raises(
        ConfigurationError, match=r"for 0\.3 m per pixel but the images have 0\.125"
    ):
        HiddenVehicles(SaysAlways(gsd_m=0.3), OneImage({}), labels=(2,))


def test_two_classes_of_one_vehicle_are_one_detection() -> None:
    theirs = SaysAlways(index2label={0: "person", 2: "car", 3: "van"})
    (found,) = ModelDetector(theirs, vehicle_classes=["car", "van"]).detect(
        torch.zeros(1, 3, 96, 96)
    )
    assert found.scores.tolist() == pytest.approx([0.9, 0.7])
    with pytest.raises(ConfigurationError, match="have no index2label"):
        ModelDetector(SaysAlways())


def test_background_is_no_other_class() -> None:
    theirs = SaysAlways(index2label={0: "__background__", 2: "car"})
    assert ModelDetector(theirs, vehicle_classes=["car"]).of_other_classes() is None


def test_a_models_id_tells_its_threshold() -> None:
    loaded, other = load_detector("retinanet"), load_detector("retinanet")
    other.set_card(replace(other.card, threshold=0.9))
    ids = [DetectorModel(each).metadata["id"] for each in (loaded, other, loaded)]
    assert ids[0] == ids[2] != ids[1]


def test_a_camouflage_is_drawn_as_its_dataset_was(
    folders: Folders, model: DetectorModel, tmp_path: Path
) -> None:
    original = Dataset.open(folders.original)
    fleet, ground = Fleet.load(folders.fleet), sp.BackgroundSet.open(folders.ground)
    light = Light(white=(0.9, 0.9, 0.8))
    renderer = sp.TorchRenderer(ground, RenderSettings(blur_sigma_px=2.4, light=light))
    scenes = original.scenes[:1]
    camouflage = sp.load_camouflage(folders.camouflage)
    render_dataset(tmp_path / "blurred", scenes, fleet, renderer)
    render_dataset(tmp_path / "hidden", scenes, fleet, renderer, camouflage=camouflage)
    blurred, hidden = VehicleDataset(tmp_path / "blurred"), VehicleDataset(tmp_path / "hidden")

    def augmentation() -> CamouflageAugmentation:
        return CamouflageAugmentation(
            camouflage, tmp_path / "blurred", folders.ground, folders.fleet
        )

    images, targets, metadata = ([each] for each in blurred[0])
    drawn, _, told = augmentation()((images, targets, metadata))
    assert np.array_equal(drawn[0], hidden.get_input(0))
    assert told[0]["rendering"] == hidden.get_metadata(0)["rendering"]
    # Without the same settings, images differ in more than camouflage.
    metric = HiddenVehicles(model, VehicleDataset(folders.original))
    with pytest.raises(ConfigurationError, match="or with other settings than the unchanged"):
        metric.update(model(drawn), targets, told)
    path = tmp_path / "blurred" / "annotations.json"
    document = json.loads(path.read_text())
    document["info"]["rendering"]["supersampling"] = 99
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigurationError, match=r"not known here \(.*supersampling\)"):
        augmentation()


def test_the_metric_refuses_what_it_cannot_pair(folders: Folders, model: DetectorModel) -> None:
    dataset = VehicleDataset(folders.original)
    metric = HiddenVehicles(model, dataset)
    image, target, metadata = dataset[0]
    found = model([image])
    with pytest.raises(ConfigurationError, match="none of the unchanged"):
        metric.update(found, [target], [{**metadata, "id": "elsewhere"}])
    metric.update(found, [target], [metadata])
    with pytest.raises(ConfigurationError, match="came twice"):
        metric.update(found, [target], [metadata])
    metric.reset()
    assert metric.compute()["easr"] is None
    nameless = SomebodysModel(["car"])
    with pytest.raises(ConfigurationError, match="no threshold"):
        HiddenVehicles(nameless, dataset)


class SomebodysModel:
    """A MAITE model of somebody else: our RetinaNet, which knows trees, too, and takes bytes."""

    def __init__(self, classes: list[str], *, columns: bool = False) -> None:
        self.metadata = {"id": "else/where 1", "index2label": dict(enumerate(classes))}
        self._columns = columns
        self._model = DetectorModel(load_detector("retinanet"))

    def __call__(self, batch_input: Any, /) -> list[SimpleNamespace]:
        answers = []
        for found in self._model(batch_input):
            label = len(self.metadata["index2label"]) - 1
            scores = found.scores
            if self._columns:
                scores = np.stack([scores * 0.25, 1 - scores, scores * 0.75], axis=1)
            labels = found.labels + label
            answers.append(SimpleNamespace(boxes=found.boxes, labels=labels, scores=scores))
        return answers


@pytest.mark.parametrize("columns", [False, True])
def test_a_maite_model_is_a_detector(folders: Folders, *, columns: bool) -> None:
    theirs = SomebodysModel(["van", "tree", "car"], columns=columns)
    image = torch.from_numpy(VehicleDataset(folders.original).get_input(0))[None]
    (expected,) = load_detector("retinanet").detect(image / 255)
    for largest_value in (1, 255):
        detector = ModelDetector(
            theirs, vehicle_classes=["car", "van"], largest_value=largest_value
        )
        assert detector.name == "else-where-1"
        (found,) = detector.detect(image / 255)
        assert torch.allclose(found.boxes, expected.boxes)
        assert torch.allclose(found.scores, expected.scores)
    (trees,) = ModelDetector(theirs, vehicle_classes=["tree"]).detect(image / 255)
    twin = BlackBoxDetector(detector).of_other_classes()
    assert twin is not None
    (others,) = twin.detect(image / 255)
    assert torch.equal(others.boxes, trees.boxes)
    assert torch.equal(others.scores, trees.scores)
    (found,) = detector.detect(image / 255)
    assert torch.allclose(found.scores, expected.scores)
    if columns:
        assert trees.scores.max() == pytest.approx(1 - float(expected.scores.min()), abs=1e-6)
    else:
        assert not len(trees.scores)


@pytest.mark.parametrize(
    ("classes", "words"),
    [([], "knows 2 classes"), (["lorry"], "no class 'lorry'; choose from tree, car")],
)
def test_a_models_classes_are_named(classes: list[str], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        ModelDetector(SomebodysModel(["tree", "car"]), vehicle_classes=classes)


def labelling(images: torch.Tensor) -> list[dict[str, Any]]:
    return [{"boxes": [], "scores": [], "labels": []}] * len(images)


def test_assess_asks_a_maite_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Request, Any]] = []
    monkeypatch.setattr(
        "skyproof.assessment.assess.run_assessment",
        lambda request, black_box: asked.append((request, black_box)),
    )
    theirs = SomebodysModel(["tree", "car"])
    sp.assess(theirs, tmp_path / "run", vehicle_classes=["car"])
    ((request, box),) = asked
    assert request.detectors == (Path("else-where-1"),)
    images = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(0))
    (found,) = box.detect(images)
    assert len(found.boxes) == len(found.scores)
    sp.assess(labelling, tmp_path / "run", vehicle_classes=["car"])
    for each in (box, asked.pop()[1]):
        assert each.of_other_classes() is not None
    with pytest.raises(ConfigurationError, match="knows 2 classes"):
        sp.assess(theirs, tmp_path / "run")
    with pytest.raises(ConfigurationError, match="architecture is for checkpoint files"):
        sp.assess(theirs, tmp_path / "run", vehicle_classes=["car"], architecture="retinanet")
    with pytest.raises(ConfigurationError, match="vehicle_classes is for checkpoint files"):
        sp.assess(box, tmp_path / "run", vehicle_classes=["car"])


def test_an_answer_of_nonsense_is_one_sentence(tmp_path: Path) -> None:
    theirs = SomebodysModel(["car"])
    found = SimpleNamespace(boxes=np.ones((1, 4)), labels=np.zeros(1), scores=np.full(1, np.nan))
    theirs._model = lambda batch: [found] * len(batch)  # type: ignore[assignment]
    detector = ModelDetector(theirs)
    with pytest.raises(DetectorAnswerError, match="finite numbers, got NaN"):
        detector.detect(torch.zeros(1, 3, 8, 8))
    found.scores = np.zeros((1, 2, 3))
    with pytest.raises(DetectorAnswerError, match="did not answer"):
        detector.detect(torch.zeros(1, 3, 8, 8))


def test_entry_points_lead_to_the_components() -> None:
    for kind, name in {
        "Model": "DetectorModel",
        "Dataset": "VehicleDataset",
        "Augmentation": "CamouflageAugmentation",
        "Metric": "HiddenVehicles",
    }.items():
        group = importlib.metadata.entry_points(group=f"maite.protocols.object_detection.{kind}")
        (point,) = (
            each for each in group if each.dist is not None and each.dist.name == "skyproof"
        )
        assert point.name == f"skyproof_{name}"
        assert point.load().__name__ == name
