"""Detectors of Detectron2: their own detections, from weights and config.yaml as data."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor
from torchvision.ops import clip_boxes_to_image

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import read_card
from skyproof.detectors.import_checkpoint import Checkpoint, import_detector, read_network
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.loaded import load_detector
from skyproof.errors import SkyproofError

# What Detectron2 of commit 02b5c4e answers; nothing of it is needed here.
NUMBERS = Path(__file__).with_name("detectron2_numbers.json")
HEIGHT_PX, WIDTH_PX = 160, 224
CLASSES = 3
ONE_STAGE, TWO_STAGES = "RetinaNet", "GeneralizedRCNN"
CONFIGS = {
    ONE_STAGE: "COCO-Detection/retinanet_R_50_FPN_1x.yaml",
    TWO_STAGES: "COCO-Detection/faster_rcnn_R_50_FPN_1x.yaml",
}


def configuration(kind: str) -> dict[str, Any]:
    """The fields of config.yaml that count, among others."""
    thirds = [[side * 2 ** (step / 3) for step in range(3)] for side in (32, 64, 128, 256, 512)]
    return {
        "VERSION": 2,
        "INPUT": {"FORMAT": "BGR", "MIN_SIZE_TEST": 800, "MAX_SIZE_TEST": 1333},
        "MODEL": {
            "META_ARCHITECTURE": kind,
            "PIXEL_MEAN": [103.53, 116.28, 123.675],
            "PIXEL_STD": [1.0, 1.0, 1.0],
            "RESNETS": {"DEPTH": 50, "STRIDE_IN_1X1": True, "NUM_GROUPS": 1, "NORM": "FrozenBN"},
            "ANCHOR_GENERATOR": {
                "SIZES": thirds if kind == ONE_STAGE else [[32], [64], [128], [256], [512]],
                "ASPECT_RATIOS": [[0.5, 1.0, 2.0]],
            },
            "ROI_BOX_HEAD": {
                "POOLER_TYPE": "ROIAlignV2",
                "POOLER_RESOLUTION": 14 if kind == ONE_STAGE else 7,
                "POOLER_SAMPLING_RATIO": 0,
            },
        },
    }


def shapes(kind: str) -> dict[str, tuple[int, ...]]:
    """Detectron2's tensors on a ResNet-50."""
    found: dict[str, tuple[int, ...]] = {}

    def convolution(name: str, out: int, into: int, side: int, *, normed: bool) -> None:
        found[f"{name}.weight"] = (out, into, side, side)
        for part in ("weight", "bias", "running_mean", "running_var") if normed else ():
            found[f"{name}.norm.{part}"] = (out,)
        if not normed:
            found[f"{name}.bias"] = (out,)

    convolution("backbone.bottom_up.stem.conv1", 64, 3, 7, normed=True)
    into = 64
    for stage, blocks in enumerate((3, 4, 6, 3)):
        middle, out = 64 * 2**stage, 256 * 2**stage
        for block in range(blocks):
            place = f"backbone.bottom_up.res{stage + 2}.{block}"
            if block == 0:
                convolution(f"{place}.shortcut", out, into, 1, normed=True)
            convolution(f"{place}.conv1", middle, into, 1, normed=True)
            convolution(f"{place}.conv2", middle, middle, 3, normed=True)
            convolution(f"{place}.conv3", out, middle, 1, normed=True)
            into = out
    for level in (3, 4, 5) if kind == ONE_STAGE else (2, 3, 4, 5):
        convolution(f"backbone.fpn_lateral{level}", 256, 64 * 2**level, 1, normed=False)
        convolution(f"backbone.fpn_output{level}", 256, 256, 3, normed=False)
    if kind == ONE_STAGE:
        convolution("backbone.top_block.p6", 256, 2048, 3, normed=False)
        convolution("backbone.top_block.p7", 256, 256, 3, normed=False)
        for branch in ("cls_subnet", "bbox_subnet"):
            for place in (0, 2, 4, 6):
                convolution(f"head.{branch}.{place}", 256, 256, 3, normed=False)
        convolution("head.cls_score", 9 * CLASSES, 256, 3, normed=False)
        convolution("head.bbox_pred", 36, 256, 3, normed=False)
        return found
    convolution("proposal_generator.rpn_head.conv", 256, 256, 3, normed=False)
    convolution("proposal_generator.rpn_head.objectness_logits", 3, 256, 1, normed=False)
    convolution("proposal_generator.rpn_head.anchor_deltas", 12, 256, 1, normed=False)
    linear = {"box_head.fc1": (1024, 12544), "box_head.fc2": (1024, 1024)}
    linear |= {"box_predictor.cls_score": (CLASSES + 1, 1024)}
    linear |= {"box_predictor.bbox_pred": (4 * CLASSES, 1024)}
    for name, shape in linear.items():
        found |= {f"roi_heads.{name}.weight": shape, f"roi_heads.{name}.bias": shape[:1]}
    return found


def weights(kind: str) -> dict[str, Tensor]:
    """The same weights on any machine; uniform numbers do not depend on the CPU."""
    generator = torch.Generator().manual_seed(5)
    found = {}
    for name, shape in sorted(shapes(kind).items()):
        uniform = torch.rand(shape, generator=generator)
        if name.endswith("running_var"):
            found[name] = 0.5 + uniform
        elif name.endswith("norm.weight"):
            # Sums over many blocks stay small.
            found[name] = (0.25 if "conv3" in name else 0.75) + uniform / 2
        elif len(shape) > 1:
            # Colours reach 255, what decides varies, and boxes stay near their anchors.
            strengths = {
                "stem": 0.02,
                "head.cls_score": 1.5,
                "predictor.cls_score": 6.0,
                "objectness": 6.0,
                "bbox_pred": 0.4,
            }
            strengths |= {"anchor_deltas": 0.4, "lateral": 0.04, "p6": 0.04}
            strength = next((each for part, each in strengths.items() if part in name), 1.3)
            found[name] = (uniform - 0.5) * strength * (12 / (uniform[0].numel())) ** 0.5
        else:
            found[name] = (uniform - 0.5) / 2
    return found


def image() -> Tensor:
    return torch.rand(3, HEIGHT_PX, WIDTH_PX, generator=torch.Generator().manual_seed(3))


def write(folder: Path, kind: str, state: dict[str, Tensor] | None = None) -> Path:
    content = {"model": weights(kind) if state is None else state, "iteration": 1}
    torch.save(content, folder / "model_final.pth")
    (folder / "config.yaml").write_text(yaml.safe_dump(configuration(kind)))
    return folder / "model_final.pth"


@pytest.fixture(scope="module", params=[ONE_STAGE, TWO_STAGES])
def checkpoint(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp(request.param), request.param)


def read(path: Path, *vehicle_classes: str) -> ImportedDetector:
    # `assess` asks for no kind.
    detector, _, _ = read_network(Checkpoint(path, "ultralytics", vehicle_classes), 1.0, "mine")
    return detector.eval().requires_grad_(False)


def test_detections_are_those_of_detectron2(checkpoint: Path) -> None:
    kind = checkpoint.parent.name[:-1]
    for number, wanted in json.loads(NUMBERS.read_text())[kind].items():
        found = read(checkpoint, number).candidates(image()[None])
        boxes = clip_boxes_to_image(found.boxes[0], (HEIGHT_PX, WIDTH_PX))
        theirs, scores = torch.tensor(wanted["boxes"]), torch.tensor(wanted["scores"])
        assert len(scores.unique()) > 15
        # Two boxes may lie at one place.
        ours = torch.cat([boxes, 100 * found.scores[0][:, None]], dim=1)
        nearest = torch.cdist(torch.cat([theirs, 100 * scores[:, None]], dim=1), ours).argmin(dim=1)
        torch.testing.assert_close(boxes[nearest], theirs, rtol=0, atol=0.5)
        torch.testing.assert_close(found.scores[0, nearest], scores, rtol=0, atol=1e-3)


def test_detectron2_itself() -> None:
    """With SKYPROOF_WRITE_GOLDEN=1 it writes the numbers that the test before reads."""
    pytest.importorskip("detectron2.modeling", reason="Detectron2 is not installed")
    from detectron2.config import get_cfg
    from detectron2.model_zoo import get_config_file
    from detectron2.modeling import build_model

    numbers: dict[str, Any] = {}
    for kind, name in CONFIGS.items():
        settings = get_cfg()
        settings.merge_from_file(get_config_file(name))
        written = yaml.safe_load(settings.dump())
        for section, wanted in (
            ("INPUT", configuration(kind)["INPUT"]),
            *configuration(kind)["MODEL"].items(),
        ):
            there = written[section] if section == "INPUT" else written["MODEL"][section]
            if isinstance(wanted, dict):
                there = {field: there[field] for field in wanted}
            assert there == wanted, section
        settings.MODEL.DEVICE, settings.MODEL.WEIGHTS = "cpu", ""
        settings.TEST.DETECTIONS_PER_IMAGE = 100_000
        for part in (settings.MODEL.RETINANET, settings.MODEL.ROI_HEADS):
            part.NUM_CLASSES, part.SCORE_THRESH_TEST, part.NMS_THRESH_TEST = CLASSES, 0.01, 1.0
        settings.MODEL.RETINANET.TOPK_CANDIDATES_TEST = 100_000
        network = build_model(settings).eval()
        own = weights(kind)
        assert {name: tuple(each.shape) for name, each in network.state_dict().items()} == {
            name: tuple(each.shape) for name, each in own.items()
        }
        network.load_state_dict(own)
        with torch.no_grad():
            (found,) = network([{"image": image().flip(0) * 255}])
        answers = found["instances"]
        numbers[kind] = {}
        for number in range(CLASSES):
            chosen = torch.nonzero(answers.pred_classes == number)[:20, 0]
            boxes, scores = answers.pred_boxes.tensor[chosen], answers.scores[chosen]
            numbers[kind][str(number)] = {"boxes": boxes.tolist(), "scores": scores.tolist()}
    if os.environ.get("SKYPROOF_WRITE_GOLDEN"):
        NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n")
    assert {*numbers[ONE_STAGE]} == {*map(str, range(CLASSES))}


@pytest.fixture(scope="module")
def two_stages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("files"), TWO_STAGES)


def told_otherwise(path: Path, folder: Path, change: Callable[[Any], object]) -> Path:
    """The same weights beside another config.yaml."""
    settings = yaml.safe_load(path.with_name("config.yaml").read_text())
    change(settings)
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    (folder / "model_final.pth").hardlink_to(path)
    return folder / "model_final.pth"


def test_it_is_stored_as_any_other(two_stages: Path, tmp_path: Path) -> None:
    detector = read(two_stages, "0", "2")
    pictures = [(image() * 255).to(torch.uint8)] * 2
    boxes = [found.boxes[:2] for found in detector.detect(torch.stack(pictures).float() / 255)]
    labelled = Dataset.of_images(pictures, boxes, gsd_m=0.125)
    asked = Checkpoint(two_stages, "detectron2", ("0", "2"))
    card = import_detector(asked, labelled, tmp_path / "mine")
    assert card == read_card(tmp_path / "mine")
    assert card.trainable
    assert card.trained_on == "elsewhere: detectron2 checkpoint model_final.pth"
    assert card.brought is not None
    assert card.brought.classes == ["background", "0", "1", "2"]
    assert (card.brought.vehicle_classes, card.brought.side_px) == ([1, 3], 800)
    again = load_detector(tmp_path / "mine")
    wanted = detector.candidates(image()[None])
    assert torch.equal(again.candidates(image()[None]).scores, wanted.scores)
    others = again.of_other_classes()
    assert others is not None
    only = read(two_stages, "1").candidates(image()[None])
    assert torch.equal(others.candidates(image()[None]).scores, only.scores)


def test_the_loss_falls_along_its_gradient(checkpoint: Path) -> None:
    detector = read(checkpoint, "1").double()
    shown = image()[None].double().requires_grad_()
    nothing = [torch.zeros(0, 4)]
    loss = detector.loss(shown, nothing)
    loss.sum().backward()
    assert shown.grad is not None
    norm = float(shown.grad.norm())
    assert norm > 0
    with torch.no_grad():
        change = float((detector.loss(shown - 1e-6 / norm * shown.grad, nothing) - loss).sum())
    # As in torchvision no gradient flows through the places of Faster R-CNN's regions.
    exact = checkpoint.parent.name.startswith(ONE_STAGE)
    assert change == pytest.approx(-1e-6 * norm, rel=0.05 if exact else 0.5)


def test_masks_and_the_order_of_colours_change_nothing(two_stages: Path, tmp_path: Path) -> None:
    wanted = read(two_stages, "0").candidates(image()[None])
    state = weights(TWO_STAGES)
    first = "backbone.bottom_up.stem.conv1.weight"
    state[first] = state[first].flip(1)
    state["roi_heads.mask_head.predictor.weight"] = torch.zeros(3, 256, 1, 1)
    path = write(tmp_path, TWO_STAGES, state)
    settings = configuration(TWO_STAGES)
    settings["INPUT"]["FORMAT"] = "RGB"
    settings["MODEL"]["PIXEL_MEAN"].reverse()
    path.with_name("config.yaml").write_text(yaml.safe_dump(settings))
    found = read(path, "0").candidates(image()[None])
    assert torch.equal(found.scores, wanted.scores)
    assert torch.equal(found.boxes, wanted.boxes)


@pytest.mark.parametrize(
    ("section", "field", "value"),
    [("RESNETS", "STRIDE_IN_1X1", False), ("ANCHOR_GENERATOR", "SIZES", [[24.0]] * 5)],
)
def test_what_the_configuration_says_is_done(
    section: str, field: str, value: object, two_stages: Path, tmp_path: Path
) -> None:
    wanted = read(two_stages, "0").candidates(image()[None])
    path = told_otherwise(
        two_stages, tmp_path, lambda told: told["MODEL"][section].update({field: value})
    )
    found = read(path, "0").candidates(image()[None])
    assert found.boxes.shape != wanted.boxes.shape or not torch.equal(found.boxes, wanted.boxes)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda told: told["MODEL"].update(META_ARCHITECTURE="PanopticFPN"), "META_ARCHITECTURE"),
        (lambda told: told["MODEL"].update(META_ARCHITECTURE="RetinaNet"), "expects names out of"),
        (lambda told: told["MODEL"]["RESNETS"].update(DEPTH=18), "DEPTH"),
        (lambda told: told["MODEL"]["RESNETS"].update(DEPTH=101), "do not fit the config.yaml"),
        (lambda told: told["MODEL"]["ROI_BOX_HEAD"].update(POOLER_TYPE="ROIAlign"), "POOLER_TYPE"),
        (lambda told: told["MODEL"].pop("PIXEL_STD"), "the field PIXEL_STD is missing"),
        (lambda told: told["MODEL"].update(PIXEL_STD=[0, 1, 1]), "PIXEL_STD"),
        (lambda told: told["INPUT"].update(FORMAT="L"), "FORMAT"),
        (lambda told: told["MODEL"]["ANCHOR_GENERATOR"].update(SIZES=[[8]] * 3), "for 3 levels"),
        (lambda told: told["MODEL"]["ANCHOR_GENERATOR"].update(SIZES=[[-8]]), "SIZES"),
        (lambda told: told["MODEL"]["ANCHOR_GENERATOR"].update(SIZES=[]), "SIZES"),
        (lambda told: told["MODEL"]["ANCHOR_GENERATOR"].update(ASPECT_RATIOS=[]), "ASPECT_RATIOS"),
        (lambda told: told.clear(), "the field MODEL is missing"),
    ],
)
def test_bad_configurations_are_one_sentence(
    change: Callable[[Any], object], said: str, two_stages: Path, tmp_path: Path
) -> None:
    with pytest.raises(SkyproofError) as refusal:
        read(told_otherwise(two_stages, tmp_path, change), "0")
    sentence = str(refusal.value)
    assert said in sentence
    assert "\n" not in sentence
    assert sentence.count(". ") == 0


@pytest.mark.parametrize(
    "content", [None, "a: [", "!!python/object/apply:os.system [ls]", "\x00", "[" * 10_000, "5"]
)
def test_a_configuration_that_is_none_is_one_sentence(
    content: str | None, two_stages: Path, tmp_path: Path
) -> None:
    path = told_otherwise(two_stages, tmp_path, lambda _: None)
    (tmp_path / "config.yaml").unlink()
    if content is not None:
        (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(SkyproofError, match=r"config.yaml (is missing or no YAML|cannot be used)"):
        read(path, "0")


def test_other_tensors_are_refused(tmp_path: Path) -> None:
    state = weights(TWO_STAGES)
    state["roi_heads.keypoint_head.conv_fcn1.weight"] = torch.zeros(1)
    del state["roi_heads.box_head.fc2.bias"]
    with pytest.raises(SkyproofError, match=r"beside it: 2 tensors differ.*give a RetinaNet, F"):
        read(write(tmp_path, TWO_STAGES, state), "0")
