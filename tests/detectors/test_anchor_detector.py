"""The YOLOv5 of 2020: outputs and loss of the package `yolov5`, and its checkpoints as data."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from detector_images import NEEDS_YOLO, bar_images
from torch import Tensor, nn
from torchvision.ops import box_convert

from skyproof.detectors.anchor_detector import AnchorDetector
from skyproof.detectors.import_checkpoint import Checkpoint, import_detector, read_ultralytics
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.ultralytics_detectors import yolov5_architecture
from skyproof.errors import ConfigurationError, SkyproofError, StoredFileError

pytestmark = NEEDS_YOLO

# What yolov5 7.0.14 (a package under the GPL-3.0) answers; none of it is needed here.
NUMBERS = Path(__file__).with_name("yolov5_numbers.json")
VALIDATION = bar_images(3, 128, seed=1)
CLASSES = ["car", "van", "tree"]
HEIGHT_PX, WIDTH_PX = 192, 256
# Anchors of release 7.0.
ANCHORS = [[10, 13, 16, 30, 33, 23], [30, 61, 62, 45, 59, 119], [116, 90, 156, 198, 373, 326]]


def of_2020() -> dict[str, Any]:
    """The one-class architecture of YOLOv5n."""
    return {**yolov5_architecture("slim"), "nc": 1, "anchors": [list(row) for row in ANCHORS]}


def image() -> Tensor:
    return torch.rand(1, 3, HEIGHT_PX, WIDTH_PX, generator=torch.Generator().manual_seed(3))


def filled(model: nn.Module) -> nn.Module:
    """The same weights whoever built the network; uniform numbers do not depend on the CPU."""
    generator = torch.Generator().manual_seed(5)
    state = model.state_dict()
    for name in sorted(state):
        value = state[name]
        if name.endswith(("num_batches_tracked", ".anchors")):
            continue
        uniform = torch.rand(value.shape, generator=generator)
        if name.endswith("running_var"):
            value.copy_(0.5 + uniform)
        elif value.ndim == 4:
            value.copy_((uniform - 0.5) * (12 / value[0].numel()) ** 0.5)
        elif name.endswith("bn.weight"):
            value.copy_(0.75 + uniform / 2)
        else:
            value.copy_(uniform - 0.5)
    return model.eval().requires_grad_(False)


def detector_of(classes: int) -> AnchorDetector:
    architecture = {**of_2020(), "nc": classes}
    detector = AnchorDetector(architecture, list(range(classes))[:2])
    filled(detector.model)
    return detector.eval().requires_grad_(False)


def numbers_of(boxes: Tensor, scores: Tensor, losses: list[float]) -> dict[str, Any]:
    """A few of the numbers, of every level, and sums over all."""
    some = range(7, len(scores), 97)
    return {
        "boxes": [boxes[index].tolist() for index in some],
        "scores": [float(scores[index]) for index in some],
        "sum_of_scores": float(scores.double().sum()),
        "losses": losses,
    }


def assert_close(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name, value in wanted.items():
        torch.testing.assert_close(
            torch.tensor(found[name]), torch.tensor(value), rtol=1e-5, atol=1e-4
        )


def test_outputs_and_losses_are_those_of_the_package() -> None:
    found = detector_of(3).candidates(image())
    one = detector_of(1)
    with torch.no_grad():
        losses = [float(one.loss(image(), [torch.zeros(0, 4)])[0])]
    wanted = json.loads(NUMBERS.read_text())
    assert len(set(wanted["scores"])) > 20
    assert_close(numbers_of(found.boxes[0], found.scores[0], losses), wanted)


def test_the_package_itself(tmp_path: Path) -> None:
    """With SKYPROOF_WRITE_GOLDEN=1 it writes the numbers that the test before reads."""
    yolo = pytest.importorskip("yolov5.models.yolo", reason="the package yolov5 is not installed")
    from yolov5.utils.loss import ComputeLoss

    file = str(Path(yolo.__file__).with_name("yolov5n.yaml"))
    theirs = filled(yolo.DetectionModel(file, ch=3, nc=3))
    theirs.names = CLASSES
    rows = theirs(image())[0][0].detach()
    scores = (rows[:, 4:5] * rows[:, 5:7]).amax(dim=1)
    boxes = box_convert(rows[:, :4], "cxcywh", "xyxy")
    # A file as the package saves it.
    torch.save({"model": theirs}, tmp_path / "best.pt")
    import_detector(
        Checkpoint(tmp_path / "best.pt", "ultralytics", CLASSES[:2]), VALIDATION, tmp_path / "out"
    )
    found = load_detector(tmp_path / "out").candidates(image())
    torch.testing.assert_close(found.scores[0], scores, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.boxes[0], boxes, rtol=1e-6, atol=1e-4)
    # Its loss, with the settings that its trainer gives it.
    single = filled(yolo.DetectionModel(file, ch=3, nc=1))
    area = HEIGHT_PX * WIDTH_PX / 640**2
    single.hyp = {"box": 0.05, "obj": area, "cls": 0.5 / 80, "cls_pw": 1.0, "obj_pw": 1.0}
    single.hyp |= {"fl_gamma": 0.0, "anchor_t": 4.0, "label_smoothing": 0.0}
    single.model[-1].train()
    criterion = ComputeLoss(single)
    losses = [criterion(single(image()), torch.zeros(0, 6))[0].item()]
    numbers = numbers_of(boxes, scores, losses)
    if os.environ.get("SKYPROOF_WRITE_GOLDEN"):
        NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n")
    assert_close(numbers, json.loads(NUMBERS.read_text()))


def stored_as_in_2020(
    path: Path, monkeypatch: pytest.MonkeyPatch, detector: AnchorDetector, **changes: Any
) -> Checkpoint:
    """A file as YOLOv5's trainer writes it: its network's class, its YAML, the anchors used.

    The YAML's own anchors are others, as where the trainer replaced them.
    """

    class DetectionModel(nn.Module):
        pass

    DetectionModel.__module__, DetectionModel.__qualname__ = "models.yolo", "DetectionModel"
    module = types.ModuleType("models.yolo")
    module.DetectionModel = DetectionModel  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "models", types.ModuleType("models"))
    monkeypatch.setitem(sys.modules, "models.yolo", module)
    stored = DetectionModel()
    head = nn.Module()
    own = detector.model.model[-1]
    head.m = own.m
    cells = own.anchors_px / torch.tensor(own.strides_px).view(-1, 1, 1)
    head.register_buffer("anchors", cells)
    head.register_buffer("anchor_grid", own.anchors_px.view(3, 1, 3, 1, 1, 2))
    layers = [*list(detector.model.model)[:-1], head]
    stored.model = nn.Sequential(*layers)
    stored.stride = torch.tensor([8.0, 16.0, 32.0])
    stored.names = CLASSES
    architecture = of_2020()
    *rows, last = architecture["head"]
    stored.yaml = {
        **architecture,
        "nc": 3,
        "anchors": 3,
        "head": [*rows, [*last[:3], ["nc", "anchors"]]],
    }
    for name, value in changes.items():
        setattr(stored, name, value)
    torch.save({"model": stored, "epoch": 3}, path)
    return Checkpoint(path, "ultralytics", ("car", "van"))


def test_a_checkpoint_of_2020(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = detector_of(3)
    detector.model.model[-1].anchors_px *= 1.1
    checkpoint = stored_as_in_2020(tmp_path / "best.pt", monkeypatch, detector)
    # Nothing of the repository of 2020 is at hand where the file is read.
    monkeypatch.undo()
    card = import_detector(checkpoint, VALIDATION, tmp_path / "out")
    assert card.brought is not None
    assert card.brought.classes == CLASSES
    assert isinstance(card.brought.architecture, dict)
    assert card.brought.architecture["anchors"][0] == pytest.approx(
        [11, 14.3, 17.6, 33, 36.3, 25.3]
    )
    found = load_detector(tmp_path / "out").candidates(image())
    wanted = detector.candidates(image())
    torch.testing.assert_close(found.scores, wanted.scores)
    torch.testing.assert_close(found.boxes, wanted.boxes)
    # The third class, which is no vehicle, has no say.
    other = import_detector(
        Checkpoint(checkpoint.path, "ultralytics", ("tree",)), VALIDATION, tmp_path / "other"
    )
    assert other.brought is not None
    assert other.brought.vehicle_classes == [2]
    trees = load_detector(tmp_path / "other").candidates(image())
    assert (trees.scores - found.scores).abs().max() > 0.01


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"stride": None}, ConfigurationError, "no anchors, or no strides"),
        ({"stride": torch.ones(2)}, ConfigurationError, "no anchors, or no strides"),
        ({"stride": -torch.ones(3)}, ConfigurationError, "anchors"),
        ({"yaml": {"head": []}}, ConfigurationError, "no anchors"),
        ({"yaml": None}, ConfigurationError, "no anchors"),
        ({"yaml": {"head": 5}}, ConfigurationError, "no anchors"),
        ({"names": None}, StoredFileError, "no class names"),
        ({"old": nn.Hardswish()}, ConfigurationError, r"compute Hardswish, SiLU.*before 4\.0"),
    ],
)
def test_what_cannot_be_built_is_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
    error: type[SkyproofError],
    message: str,
) -> None:
    checkpoint = stored_as_in_2020(tmp_path / "best.pt", monkeypatch, detector_of(3), **changes)
    with pytest.raises(error, match=message):
        import_detector(checkpoint, VALIDATION, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("anchors", "message"),
    [
        ([[10, 13], [30, 61]], "for each of 3 levels"),
        ([[10, 13], [30, 61], [116, 90, 1, 2]], "for each of 3 levels"),
        ([[10, 13, 1]] * 3, "pairs of width and height"),
        ([[10, -13]] * 3, "architecture"),
        ([[10, float("nan")]] * 3, "architecture"),
    ],
)
def test_anchors_of_a_strangers_folder(anchors: list[list[float]], message: str) -> None:
    from skyproof.detectors.blueprint import check_layers

    with pytest.raises(ConfigurationError, match=message):
        check_layers({**of_2020(), "anchors": anchors})


def test_an_activation_stays_with_its_network() -> None:
    from skyproof.detectors.ultralytics_detectors import build_model

    plain = {**of_2020()}
    del plain["anchors"]
    other = build_model({**plain, "activation": "nn.LeakyReLU(0.1)"})
    usual = build_model(plain)
    assert isinstance(other.model[9].cv1.act, nn.LeakyReLU)
    assert isinstance(usual.model[9].cv1.act, nn.SiLU)
    assert isinstance(usual.model[0].act, nn.SiLU)


@pytest.mark.parametrize("activated", [True, False])
def test_a_pooling_layer_computes_what_it_was_trained_with(tmp_path: Path, activated: bool) -> None:
    """Ultralytics 8.4.0 left an activation out of SPPF, and later releases put it back."""
    from skyproof.detectors.checkpoints import networks_in, read_checkpoint
    from skyproof.detectors.ultralytics_detectors import build_model

    plain = {**of_2020()}
    del plain["anchors"]
    model = build_model(plain)
    model.names = {0: "car"}
    if not activated:
        model.model[9].cv1.act = nn.Identity()
    torch.save({"model": model}, tmp_path / "best.pt")
    network = next(iter(networks_in(read_checkpoint(tmp_path / "best.pt")).values()))
    checkpoint = Checkpoint(tmp_path / "best.pt", "ultralytics", ["car"])
    architecture, *_ = read_ultralytics(checkpoint, network, {}, "")
    rebuilt = build_model(architecture)
    assert isinstance(rebuilt.model[9].cv1.act, nn.SiLU if activated else nn.Identity)
    rebuilt.load_state_dict(model.state_dict())
    wanted, found = model.eval()(image())[0], rebuilt.eval()(image())[0]
    torch.testing.assert_close(found, wanted)


def test_a_program_that_read_an_architecture_ends_well() -> None:
    """Texts with a `pattern` in msgspec's types made one in six crash while ending."""
    program = (
        "from skyproof.detectors.blueprint import check_layers\n"
        "rows = [[-1, 1, 'Conv', [64, 6, 2, 2]]] * 9\n"
        "check_layers({'backbone': rows, 'head': [[[1, 2], 1, 'Detect', ['nc']]]})\n"
    )
    running = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(16)]
    assert [each.wait(timeout=120) for each in running] == [0] * 16
