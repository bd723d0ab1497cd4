"""Imported networks: the libraries' own detections, and the loss tests of ours (section 3.2)."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from detector_images import PLAN, YOLO, bar_images, needs_yolo, rt_detr_plan, yolo_plan
from torch import nn
from torch.nn import functional
from torchvision.models import detection
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.ops import box_convert
from torchvision.ops.feature_pyramid_network import LastLevelP6P7

from skyproof.detectors.blueprint import ARCHITECTURES
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.imported import ImportedDetector, ImportedFasterRcnn, ImportedFcos
from skyproof.detectors.ultralytics_detectors import (
    RtDetrNetwork,
    YoloNetwork,
    _refuse_giants,
)
from skyproof.errors import ConfigurationError
from skyproof.storage import weights_digest

LABELLED = bar_images(3, seed=1)
IMAGES = torch.stack(LABELLED.images(range(len(LABELLED)))).float() / 255
SEEN = list(LABELLED.boxes)
NOTHING = [torch.zeros(0, 4)] * len(IMAGES)
SMALL = "fasterrcnn_mobilenet_v3_large_fpn"
ONE_OF_EACH = [SMALL, "fcos_resnet50_fpn", "retinanet_resnet50_fpn"]
OTHER_BACKBONES = ["fasterrcnn_resnet18_fpn", "maskrcnn_resnet34_fpn", "retinanet_resnet18_fpn"]


def livened(detector: ImportedDetector) -> ImportedDetector:
    """Random weights that tell places and classes apart, which fresh ones do not."""
    generator = torch.Generator().manual_seed(7)
    model = detector.network.model
    # FCOS normalises the features before the last layer, which is why they are larger there.
    spread = (1.5, 0.02 if isinstance(detector.network, ImportedFcos) else 0.3)
    for name, parameter in model.named_parameters():
        if "score_head" in name or "bbox_head" in name:
            with torch.no_grad():
                parameter.copy_(0.15 * torch.randn(parameter.shape, generator=generator))
        last = ("cls_logits", "cls_score", ".cv3.0.2", ".cv3.1.2", ".cv3.2.2", "ctrness")
        if any(part in name for part in last):
            with torch.no_grad():
                parameter.copy_(
                    spread[parameter.ndim > 1] * torch.randn(parameter.shape, generator=generator)
                )
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            # Else the features of a deep random network are all alike.
            module.momentum = 1.0
    detector.train()
    if isinstance(detector.network, RtDetrNetwork):
        # It stays as it infers.
        model.train()
    with torch.no_grad():
        own = isinstance(detector.network, YoloNetwork | RtDetrNetwork)
        model(IMAGES) if own else detector.network.candidates(IMAGES)
    return detector.eval().requires_grad_(False)


@pytest.fixture(
    scope="module",
    params=[
        *ONE_OF_EACH,
        pytest.param("yolov8n.yaml", marks=YOLO.marks),
        pytest.param("rtdetr-l.yaml", marks=YOLO.marks),
    ],
)
def imported(request: pytest.FixtureRequest) -> ImportedDetector:
    torch.manual_seed(0)
    if request.param == "rtdetr-l.yaml":
        return livened(ImportedDetector("mine", rt_detr_plan([1, 2])))
    if request.param.endswith(".yaml"):
        return livened(ImportedDetector("mine", yolo_plan(request.param, [1, 2])))
    return livened(
        ImportedDetector("mine", replace(PLAN, architecture=request.param, vehicle_classes=[1, 3]))
    )


def torchvision_network(architecture: str, **limits: Any) -> nn.Module:
    """As torchvision's users build it, on their backbone."""
    family, backbone, *_ = architecture.split("_")
    if architecture not in OTHER_BACKBONES:
        return getattr(detection, architecture)(
            weights=None, weights_backbone=None, num_classes=len(PLAN.classes), **limits
        )
    build = {"fasterrcnn": detection.FasterRCNN, "maskrcnn": detection.MaskRCNN}.get(family)
    if build is not None:
        return build(
            resnet_fpn_backbone(backbone_name=backbone, weights=None, norm_layer=nn.BatchNorm2d),
            4,
            **limits,
        )
    pyramid = resnet_fpn_backbone(
        backbone_name=backbone,
        weights=None,
        norm_layer=nn.BatchNorm2d,
        returned_layers=[2, 3, 4],
        extra_blocks=LastLevelP6P7(256, 256),
    )
    return detection.RetinaNet(pyramid, 4, **limits)


@pytest.mark.parametrize(
    ("architecture", "normalised"),
    [
        *((name, True) for name in (*ONE_OF_EACH, *OTHER_BACKBONES)),
        ("fasterrcnn_resnet18_fpn", False),
    ],
)
def test_detections_are_those_of_torchvision(architecture: str, normalised: bool) -> None:
    torch.manual_seed(1)
    plan = replace(PLAN, architecture=architecture, normalised=normalised)
    ours = livened(ImportedDetector("mine", plan))
    limits: dict[str, Any] = {"min_size": 96, "max_size": 96}
    if not normalised:
        limits |= {"image_mean": [0, 0, 0], "image_std": [1, 1, 1]}
    if "rcnn" in architecture:
        limits |= {"box_score_thresh": 0.01, "box_detections_per_img": 10_000}
    else:
        limits |= {
            "score_thresh": 0.01,
            "nms_thresh": 0.5,
            "topk_candidates": 100_000,
            "detections_per_img": 10_000,
        }
    theirs = torchvision_network(architecture, **limits).eval()
    # What draws masks has no part in boxes.
    masks = {name: value for name, value in theirs.state_dict().items() if ".mask_" in name}
    theirs.load_state_dict({**ours.network.model.state_dict(), **masks})
    with torch.no_grad():
        wanted = theirs(list(IMAGES))
    for found, want in zip(ours.detect(IMAGES), wanted, strict=True):
        # Boxes of no size are not among ours.
        vehicles = (want["labels"] == 2) & (want["boxes"][:, 2:] - want["boxes"][:, :2] > 0.5).all(
            dim=1
        )
        scores, boxes = want["scores"][vehicles][:90], want["boxes"][vehicles][:90]
        assert len(scores) > (20 if architecture in ONE_OF_EACH else 3)
        torch.testing.assert_close(found.scores[: len(scores)], scores, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.boxes[: len(scores)], boxes, rtol=1e-3, atol=1e-2)


def test_other_classes_are_those_that_are_no_vehicles(imported: ImportedDetector) -> None:
    vehicles = imported.detect(IMAGES)
    network: Any = imported.network
    before = network.vehicle_classes
    twin = imported.of_other_classes()
    assert twin is not None
    # Class 0 is the background of Faster R-CNN.
    of_kind = {ImportedFasterRcnn: [2], YoloNetwork: [0], RtDetrNetwork: [0]}
    two = of_kind.get(type(network), [0, 2])
    classes: Any = twin.network.vehicle_classes
    assert [*classes] == two
    assert network.vehicle_classes == before
    others, again = twin.detect(IMAGES), imported.detect(IMAGES)
    for one, other, repeated in zip(vehicles, others, again, strict=True):
        assert torch.equal(one.scores, repeated.scores)
        assert not torch.equal(one.scores[:5], other.scores[:5])


def test_a_detector_of_vehicles_alone_has_no_other_classes() -> None:
    plan = replace(PLAN, classes=["0", "1"], vehicle_classes=[1])
    assert ImportedDetector("mine", plan).of_other_classes() is None


@needs_yolo
@pytest.mark.parametrize(
    "file",
    [
        "yolov5n.yaml",
        "yolov8n.yaml",
        "yolo11n.yaml",
        "yolo26n.yaml",
        "yolov8n-obb.yaml",
        "yolo26n-obb.yaml",
        "yolov8n-seg.yaml",
        "yolo26n-seg.yaml",
    ],
)
def test_candidates_are_those_of_ultralytics(file: str) -> None:
    torch.manual_seed(2)
    ours = livened(ImportedDetector("mine", yolo_plan(file, [1])))
    from ultralytics.utils.ops import xywhr2xyxyxyxy

    with torch.no_grad():
        decoded = ours.network.model(IMAGES)[0]
    if "seg" in file:
        decoded, _masks = decoded
    found = ours.candidates(IMAGES)
    torch.testing.assert_close(found.scores, decoded[:, 4 + 1])
    boxes = decoded[:, :4].permute(0, 2, 1)
    if "obb" in file:
        corners = xywhr2xyxyxyxy(torch.cat([boxes, decoded[:, -1:].permute(0, 2, 1)], dim=-1))
        wanted = torch.cat([corners.amin(dim=-2), corners.amax(dim=-2)], dim=-1)
        assert (wanted[..., 2:] - wanted[..., :2] - boxes[..., 2:]).abs().max() > 1
    else:
        wanted = box_convert(boxes, "cxcywh", "xyxy")
    torch.testing.assert_close(found.boxes, wanted, rtol=1e-4, atol=1e-3)


@needs_yolo
def test_loss_is_ultralytics_own_against_an_empty_truth() -> None:
    ours = livened(ImportedDetector("mine", yolo_plan("yolov8n.yaml", [0, 1, 2])))
    from ultralytics.cfg import get_cfg
    from ultralytics.utils.loss import v8DetectionLoss

    model = ours.network.model
    model.args = get_cfg()
    nothing = {"batch_idx": torch.zeros(0), "cls": torch.zeros(0), "bboxes": torch.zeros(0, 4)}
    for image, loss in zip(IMAGES, ours.loss(IMAGES, NOTHING), strict=True):
        terms, _ = v8DetectionLoss(model)(model(image[None])[1], nothing)
        torch.testing.assert_close(loss, terms.sum() / 10, rtol=1e-4, atol=1e-5)


@needs_yolo
@pytest.mark.parametrize("file", ["yolo26n.yaml", "yolov10n.yaml"])
def test_a_network_with_two_heads_can_be_attacked(file: str) -> None:
    """Ultralytics before 8.4.113 cut the gradient of the head that is read."""
    detector = ImportedDetector("mine", yolo_plan(file, [1])).eval().requires_grad_(False)
    images = IMAGES[:1].clone().requires_grad_()
    detector.loss(images, NOTHING[:1]).sum().backward()
    assert images.grad is not None
    assert images.grad.abs().sum() > 0


@needs_yolo
def test_a_vehicle_class_that_the_network_does_not_tell_apart_is_refused() -> None:
    plan = replace(yolo_plan("yolov8n.yaml", [1]), classes=["car"] * 9, vehicle_classes=[7])
    with pytest.raises(ConfigurationError, match="class 7 is not among the 3 that the network"):
        ImportedDetector("mine", plan)


@pytest.mark.parametrize(
    ("architecture", "regions"), [(SMALL, 1000), ("fasterrcnn_mobilenet_v3_large_320_fpn", 150)]
)
def test_regions_read_the_levels_that_torchvision_reads(architecture: str, regions: int) -> None:
    detector = ImportedDetector("mine", replace(PLAN, architecture=architecture)).eval()
    model = detector.network.model
    assert model.rpn.post_nms_top_n() == regions
    with torch.no_grad():
        detector.candidates(IMAGES[:1])
    # Two levels of one stride; the proposals' pooled third one has half as many rows.
    assert model.roi_heads.box_roi_pool.scales == [1 / 32, 1 / 32]


def test_losses_by_their_formulas() -> None:
    """Focal loss; of Faster R-CNN every region is background and every anchor negative."""
    torch.manual_seed(3)
    retinanet = livened(
        ImportedDetector("mine", replace(PLAN, architecture="retinanet_resnet50_fpn"))
    )
    scores = retinanet.candidates(IMAGES).scores.double()
    focal = (0.75 * scores**2 * -torch.log1p(-scores)).sum(dim=1) / 8
    torch.testing.assert_close(
        retinanet.loss(IMAGES, NOTHING).double(), focal, rtol=1e-4, atol=1e-6
    )
    fcos = livened(ImportedDetector("mine", replace(PLAN, architecture="fcos_resnet50_fpn")))
    assert isinstance(fcos.network, ImportedFcos)
    p = fcos.network._outputs(IMAGES)[0]["cls_logits"].sigmoid().double()
    focal = (0.75 * p**2 * -torch.log1p(-p)).sum(dim=(1, 2)) / 8
    torch.testing.assert_close(fcos.loss(IMAGES, NOTHING).double(), focal, rtol=1e-4, atol=1e-6)
    rcnn = livened(
        ImportedDetector("mine", replace(PLAN, classes=PLAN.classes[:2], vehicle_classes=[1]))
    )
    assert isinstance(rcnn.network, ImportedFasterRcnn)
    named, _ = rcnn.network._features(IMAGES)
    features = list(named.values())
    anchors = torch.cat(
        [level.flatten(1) for level in rcnn.network.model.rpn.head(features)[0]], dim=1
    )
    found = rcnn.candidates(IMAGES)
    # Padding has a score of 0.
    regions = -torch.log1p(-found.scores).sum(dim=1) / (found.scores > 0).sum(dim=1)
    torch.testing.assert_close(
        rcnn.loss(IMAGES, NOTHING),
        regions + functional.softplus(anchors).sum(dim=1) / 64,
        rtol=1e-4,
        atol=1e-5,
    )


def test_loss_of_an_image_is_its_own_finite_and_moves_the_score(imported: ImportedDetector) -> None:
    together = imported.loss(IMAGES, NOTHING)
    alone = torch.cat([imported.loss(image[None], NOTHING[:1]) for image in IMAGES])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)
    assert torch.isfinite(together).all()
    assert (together > 0).all()
    digest = weights_digest(imported)
    images = IMAGES.clone().requires_grad_()
    losses = imported.loss(images, NOTHING)
    losses.sum().backward()
    gradient = images.grad
    assert gradient is not None
    assert torch.isfinite(gradient).all()
    # Along the gradient the loss falls as the gradient says.
    step = 1e-3 / float(gradient.norm())
    with torch.no_grad():
        change = imported.loss(IMAGES - step * gradient, NOTHING).sum() - losses.sum()
    assert float(change) == pytest.approx(-1e-3 * float(gradient.norm()), rel=0.3)
    imported.detect(IMAGES)
    assert weights_digest(imported) == digest


def test_candidates_are_differentiable_and_detections_sorted(imported: ImportedDetector) -> None:
    images = IMAGES.clone().requires_grad_()
    found = imported.candidates(images)
    found.scores.max().backward()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert images.grad.abs().sum() > 0
    for detections in imported.detect(IMAGES):
        assert 0 < len(detections.scores) <= 100
        assert torch.equal(detections.scores, detections.scores.sort(descending=True).values)
        assert (detections.boxes >= 0).all()
        assert (detections.boxes <= 96).all()


def test_several_vehicle_classes_give_the_best_of_each(imported: ImportedDetector) -> None:
    network: Any = imported.network
    both = list(network.vehicle_classes)
    single = []
    try:
        for index in both:
            network.vehicle_classes = type(network.vehicle_classes)([index])
            single.append(imported.candidates(IMAGES).scores)
    finally:
        network.vehicle_classes = type(network.vehicle_classes)(both)
    torch.testing.assert_close(imported.candidates(IMAGES).scores, torch.maximum(*single))
    assert (single[0] != single[1]).any()


def test_what_no_loss_or_network_can_take_is_refused(imported: ImportedDetector) -> None:
    with pytest.raises(ConfigurationError, match="one tensor of boxes per image"):
        imported.loss(IMAGES, NOTHING[:1])
    with pytest.raises(ConfigurationError, match="at least 96 px"):
        imported.detect(torch.zeros(1, 3, 64, 200))


@needs_yolo
@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("yolov8n-obb.yaml", {}),
        ("yolov5n.yaml", {"anchors": [[10, 13, 16, 30], [30, 61, 62, 45], [116, 90, 156, 198]]}),
    ],
)
def test_networks_whose_loss_knows_no_vehicles_say_so(file: str, change: dict[str, Any]) -> None:
    plan = yolo_plan(file, [1])
    assert isinstance(plan.architecture, dict)
    plan = replace(plan, architecture={**plan.architecture, **change})
    assert not plan.trainable
    detector = ImportedDetector("mine", plan).eval()
    assert torch.isfinite(detector.loss(IMAGES, NOTHING)).all()
    with pytest.raises(ConfigurationError, match="mine finds turned boxes or is a YOLOv5 of 2020"):
        detector.loss(IMAGES, SEEN)


@pytest.mark.parametrize("architecture", ["fcos_resnet50_fpn", "retinanet_resnet50_fpn"])
def test_loss_with_vehicles_is_torchvisions(architecture: str) -> None:
    plan = replace(PLAN, architecture=architecture, classes=["0"], vehicle_classes=[0])
    assert plan.trainable
    ours = livened(ImportedDetector("mine", plan))
    theirs = getattr(detection, architecture)(
        weights=None, weights_backbone=None, num_classes=1, min_size=96, max_size=96
    )
    theirs.load_state_dict(ours.network.model.state_dict())
    # Statistics stay, and losses are told only in the mode of training.
    for layer in theirs.train().modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.eval()
    found = ours.loss(IMAGES, SEEN)
    for image, boxes, loss in zip(IMAGES, SEEN, found, strict=True):
        if len(boxes):
            labels = torch.zeros(len(boxes), dtype=torch.int64)
            terms = theirs([image], [{"boxes": boxes, "labels": labels}])
            torch.testing.assert_close(loss, sum(terms.values()), rtol=1e-4, atol=1e-5)


def test_regions_learn_the_likeliest_vehicle_class() -> None:
    """The library's loss of Faster R-CNN draws regions at random, so it cannot be compared."""
    plan = replace(PLAN, vehicle_classes=[1, 3])
    detector = livened(ImportedDetector("mine", plan))
    network = detector.network
    assert isinstance(network, ImportedFasterRcnn)
    logits = torch.tensor([[0.0, 1, 9, 2], [0, 3, 9, 1], [5, 0, 0, 0]], requires_grad=True)
    deltas = torch.zeros(3, 16, requires_grad=True)
    regions = torch.tensor([[10.0, 10, 50, 30], [12, 10, 50, 30], [70, 70, 90, 90]])
    network._region_loss(logits, deltas, regions, torch.tensor([[10.0, 11, 50, 31]])).backward()
    assert logits.grad is not None
    assert deltas.grad is not None
    # Rises: class 3 of the first region, class 1 of the second, background of the third.
    assert [row.argmin().item() for row in logits.grad] == [3, 1, 0]
    moved = deltas.grad.view(3, 4, 4).abs().sum(dim=2) > 0
    assert moved.tolist() == [
        [False, False, False, True],
        [False, True, False, False],
        [False] * 4,
    ]


@needs_yolo
@pytest.mark.parametrize(
    "file",
    ["yolov8n.yaml", "yolo26n.yaml", "yolov10n.yaml", "yolov8n-seg.yaml", "yolo26n-seg.yaml"],
)
def test_loss_with_vehicles_is_ultralytics_own(file: str) -> None:
    plan = yolo_plan(file, [0])
    assert isinstance(plan.architecture, dict)
    assert plan.trainable
    plan = replace(plan, architecture={**plan.architecture, "nc": 1}, classes=["0"])
    ours = livened(ImportedDetector("mine", plan))
    from ultralytics.cfg import get_cfg
    from ultralytics.utils.loss import E2ELoss, v8DetectionLoss

    model: Any = ours.network.model
    model.args = get_cfg()
    both = hasattr(model.model[-1], "one2one_cv2")
    # The head without suppression counts in a network that is used without it.
    for alone in (False, True) if both else (False,):
        model.model[-1].end2end = alone
        criterion = E2ELoss(model).one2one if alone else v8DetectionLoss(model)
        for image, boxes, loss in zip(IMAGES, SEEN, ours.loss(IMAGES, SEEN), strict=True):
            if not len(boxes):
                continue
            raw = model(image[None])[1]
            if both:
                raw = raw["one2one" if alone else "one2many"]
            zeros = torch.zeros(len(boxes))
            centred = box_convert(boxes, "xyxy", "cxcywh") / 96
            terms, _ = criterion(raw, {"batch_idx": zeros, "cls": zeros, "bboxes": centred})
            torch.testing.assert_close(loss, terms.sum(), rtol=1e-4, atol=1e-4)


def test_loss_with_vehicles_is_at_the_networks_resolution(imported: ImportedDetector) -> None:
    at_twice = copy.copy(imported)
    at_twice.image_scale = 2.0
    large = functional.interpolate(
        IMAGES, scale_factor=2, mode="bilinear", align_corners=False, antialias=True
    )
    wanted = imported.loss(large, [2 * boxes for boxes in SEEN])
    torch.testing.assert_close(at_twice.loss(IMAGES, SEEN), wanted, rtol=1e-4, atol=1e-4)
    # An image without vehicles has its own loss among others.
    alone = imported.loss(IMAGES[:1], NOTHING[:1])
    mixed = imported.loss(IMAGES, [NOTHING[0], *SEEN[1:]])
    torch.testing.assert_close(mixed[:1], alone, rtol=1e-4, atol=1e-5)


@needs_yolo
def test_an_rt_detr_of_ultralytics_answers_and_costs_as_there() -> None:
    torch.manual_seed(0)
    ours = livened(ImportedDetector("mine", rt_detr_plan([0, 1, 2])))
    model: Any = ours.network.model
    answers, raw = model(IMAGES)
    for found, wanted in zip(ours.detect(IMAGES), answers, strict=True):
        # Ultralytics lists a query once for each class, the best of all first.
        best = wanted[wanted[:, 4] > 0.05][:3]
        assert len(best) > 1
        boxes = box_convert(best[:, :4], "cxcywh", "xyxy") * 96
        nearest = torch.cdist(boxes.clamp(0, 96), found.boxes).min(dim=1)
        assert float(nearest.values.max()) < 0.5
        assert float(found.scores[0]) == pytest.approx(float(best[0, 4]), abs=1e-3)
    criterion = model.init_criterion()
    nothing = {"cls": torch.zeros(0, dtype=torch.int64), "bboxes": torch.zeros(0, 4)}
    for index, loss in enumerate(ours.loss(IMAGES, NOTHING)):
        # The last layer's answers to this image.
        boxes, logits = (part[-1:, index : index + 1] for part in raw[:2])
        terms = criterion((boxes, logits), {**nothing, "gt_groups": [0]})
        torch.testing.assert_close(loss, terms["loss_class"])
    one = rt_detr_plan([0])
    assert isinstance(one.architecture, dict)
    one = replace(one, architecture={**one.architecture, "nc": 1}, classes=["0"])
    ours = livened(ImportedDetector("mine", one))
    model = ours.network.model
    boxes = SEEN[2]
    truth = {
        "img": IMAGES[2:],
        "batch_idx": torch.zeros(len(boxes)),
        "cls": torch.zeros(len(boxes)),
        "bboxes": box_convert(boxes / 96, "xyxy", "cxcywh"),
    }
    wanted = model.loss(truth, model(IMAGES[2:]))[0].sum()
    torch.testing.assert_close(ours.train().loss(IMAGES, SEEN)[2], wanted, rtol=1e-4, atol=1e-4)


class Blobs(TrainableDetector):
    """A network of another resolution: one box around what is bright; keeps what it saw."""

    name, size = "blobs", "brought"

    def candidates(self, images: torch.Tensor) -> Any:
        from skyproof.detectors.detector import Candidates

        self.seen = images
        boxes = []
        for image in images:
            rows, columns = (image.mean(dim=0) > 0.5).nonzero(as_tuple=True)
            boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        return Candidates(
            torch.tensor(boxes, dtype=torch.float32)[:, None],
            torch.ones(len(boxes), 1),
        )

    def loss(self, images: torch.Tensor, targets: Any) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.417, 2.5])
def test_images_are_brought_to_the_networks_resolution_and_boxes_back(scale: float) -> None:
    detector = ImportedDetector("mine", replace(PLAN, image_scale=scale))
    network = detector.network = Blobs()
    images = torch.zeros(1, 3, 150, 240)
    images[:, :, 40:80, 100:200] = 1
    (found,) = detector.detect(images)
    assert network.seen.shape[-2:] == (max(96, round(150 * scale)), max(96, round(240 * scale)))
    assert (found.boxes[0] - torch.tensor([100.0, 40, 200, 80])).abs().max() <= 1 / min(
        scale, 1
    ) + 1e-3
    images.requires_grad_()
    detector.loss(images, [torch.zeros(0, 4)]).sum().backward()
    assert images.grad is not None
    assert (images.grad > 0).all()


def test_windows_are_as_large_as_in_training() -> None:
    def window_px(**change: Any) -> int:
        return ImportedDetector("mine", replace(PLAN, **change)).window_px

    assert window_px() == 800
    assert window_px(side_px=1024) == 1024
    assert window_px(side_px=1024, image_scale=2.0) == 512
    # At most so many pixels are computed at once, and a window holds whole vehicles.
    assert window_px(side_px=4096) == 2048
    assert window_px(side_px=64) == 192


def test_scaling_down_does_not_alias() -> None:
    detector = ImportedDetector("mine", replace(PLAN, image_scale=0.5))
    detector.network = Blobs()
    stripes = torch.zeros(1, 3, 200, 200)
    stripes[..., ::2] = 1
    shown = detector._scaled(stripes)
    assert (shown[..., 2:-2] - 0.5).abs().max() < 0.02


def test_no_proposal_at_all_has_a_finite_loss() -> None:
    """The small Faster R-CNN drops proposals of low objectness: an image may be left with none."""
    detector = ImportedDetector("mine", PLAN).eval()
    nn.init.constant_(detector.network.model.rpn.head.cls_logits.bias, -20.0)
    loss = detector.loss(IMAGES, NOTHING)
    assert torch.isfinite(loss).all()
    assert all(len(found.scores) == 0 for found in detector.detect(IMAGES))


def test_building_leaves_the_programs_random_numbers_alone() -> None:
    state = torch.get_rng_state()
    ImportedDetector("mine", PLAN)
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "detectron2"},
        {"architecture": "ssd300_vgg16"},
        {"vehicle_classes": []},
        {"vehicle_classes": [4]},
        {"image_scale": 1000.0},
    ],
)
def test_blueprints_that_build_nothing_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        replace(PLAN, **change)


def edited(change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    layers = {
        "nc": 3,
        "backbone": [[-1, 1, "Conv", [16, 3, 2]]],
        "head": [[[0], 1, "Detect", ["nc"]]],
    }
    change(layers)
    return layers


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda layers: layers["backbone"].append([-1, 1, "load_checkpoint", ["weights.pt"]]),
            "load_checkpoint",
        ),
        (
            lambda layers: layers["backbone"].append([-1, 1, "Conv", ["/etc/passwd"]]),
            "backbone and head",
        ),
        (
            lambda layers: layers["backbone"].append([-1, 10**9, "Conv", [64]]),
            "backbone and head.*<= 100",
        ),
        (
            lambda layers: layers["backbone"].append([-1, 1, "Conv", [10**9]]),
            "backbone and head",
        ),
        (lambda layers: layers["backbone"].extend([[-1, 1, "Conv", [8]]] * 999), "<= 200"),
        (
            lambda layers: layers["backbone"].append(
                [-1, 1, "torchvision.ops.Conv2dNormActivation", []]
            ),
            "torchvision",
        ),
        (lambda layers: layers.update(activation="__import__('os').system('true')"), "activation"),
        (lambda layers: layers.update(activation="nn.SiLU() or print(1)"), "activation"),
        (lambda layers: layers.update(head=[[[0], 1, "Pose", ["nc"]]]), "Pose"),
        (lambda layers: layers.update(channels=4), "4 channels"),
        (lambda layers: layers.pop("head"), "backbone and head"),
    ],
)
def test_an_architecture_runs_no_code(
    change: Callable[[dict[str, Any]], None], message: str
) -> None:
    """Ultralytics evaluates an activation's text and calls what a layer's name stands for."""
    with pytest.raises(ConfigurationError, match=message):
        replace(PLAN, kind="ultralytics", architecture=edited(change))
    replace(
        PLAN,
        kind="ultralytics",
        architecture=edited(lambda layers: layers.update(activation="nn.ReLU(inplace=True)")),
    )


def test_every_architecture_builds(monkeypatch: pytest.MonkeyPatch) -> None:
    # Built without memory: names and shapes are what is checked.
    with torch.device("meta"):
        for architecture in ARCHITECTURES:
            network = ImportedDetector("mine", replace(PLAN, architecture=architecture)).network
            assert network.vehicle_classes == (2,)


@needs_yolo
@pytest.mark.parametrize(
    ("row", "message"),
    [
        ([-1, 1, "Conv", [16, 99, 2]], "kernel_size 99, expected 1 to 31"),
        ([-1, 1, "Conv", [16, 3, 0]], "stride 0, expected 1 to 8"),
        ([-1, 1, "Conv", [16, 3, 2, 4000]], "padding 4000, expected 0 to 31"),
        ([-1, 1, "Conv", [16, 3, 2, 1, 1, 99]], "dilation 99, expected 1 to 8"),
        ([-1, 1, "nn.ZeroPad2d", [[0, 4000, 0, 0]]], "padding 4000, expected 0 to 31"),
        ([-1, 1, "nn.MaxPool2d", [99, 2, 0]], "kernel_size 99, expected 1 to 31"),
    ],
    ids=str,
)
def test_a_layer_with_a_wide_window_is_refused(row: list[Any], message: str) -> None:
    plan = yolo_plan("yolov8n.yaml", [0])
    layers = json.loads(json.dumps(plan.architecture))
    layers["backbone"][0] = row
    with pytest.raises(ConfigurationError, match=message):
        ImportedDetector("mine", replace(plan, architecture=layers))


@needs_yolo
@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[-1, 100, "Conv", [8192, 3, 1]]], "numbers at once"),
        ([[-1, 1, "nn.Upsample", ["None", 4096, "nearest"]]], "numbers at once"),
        ([[-1, 1, "nn.Upsample", ["None", 64, "nearest"]]], "numbers at once"),
        ([[-1, 1, "nn.Upsample", ["None", 8, "nearest"]]] * 2, "numbers at once"),
        ([[-1, 1, "Conv", [64, 1, 1]]] * 180, "500,000,000 numbers"),
        ([[-1, 1, "Conv", [256, 3, 2]], *[[-1, 1, "Conv", [4096, 31, 8]]] * 2], "numbers at once"),
        ([[-1, 1, "Conv", [96, 31, 1]]] * 3, "operations"),
        ([[-1, 100, "C2f", [16, True]]] * 199, "10,000 parts"),
        ([[-1, 1, "ResNetLayer", [16, 16, 1, False, 8192]]], "10,000 parts"),
    ],
    ids=["wide", "4096", "64", "8x8", "many", "weights", "window", "C2f", "ResNet"],
)
def test_a_network_of_any_size_is_refused_before_it_takes_memory(
    rows: list[list[Any]], message: str
) -> None:
    plan = yolo_plan("yolov8n.yaml", [0])
    layers = json.loads(json.dumps(plan.architecture))
    layers |= {"depth_multiple": 1.0, "width_multiple": 1.0, "scales": None}
    layers["backbone"] = rows
    layers["head"] = [[[len(rows) - 1], 1, "Detect", ["nc"]]]
    started = time.monotonic()
    with pytest.raises(ConfigurationError, match=f"more than .*{message}"):
        ImportedDetector("mine", replace(plan, architecture=layers))
    assert time.monotonic() - started < 20


@needs_yolo
@pytest.mark.parametrize("file", ["yolov8x.yaml", "yolov9e.yaml", "yolo26x.yaml"])
def test_the_largest_published_networks_are_not_refused(file: str) -> None:
    _refuse_giants(yolo_plan(file, [0]).architecture)  # type: ignore[arg-type]


@needs_yolo
def test_a_network_that_cannot_see_small_images_says_so() -> None:
    plan = yolo_plan("yolov8n.yaml", [0])
    layers = json.loads(json.dumps(plan.architecture))
    layers["backbone"] = [[-1, 1, "Conv", [16, 3, 2]]] * 5 + [[-1, 1, "nn.AvgPool2d", [7, 1]]]
    layers["head"] = [[[5], 1, "Detect", ["nc"]]]
    detector = ImportedDetector("mine", replace(plan, architecture=layers)).eval()
    assert len(detector.detect(torch.zeros(1, 3, 256, 256))) == 1
    for look in (detector.detect, detector.pyramid, lambda images: detector.loss(images, [EMPTY])):
        with pytest.raises(ConfigurationError, match="mine cannot see images of 96 x 96 px"):
            look(torch.zeros(1, 3, 96, 96))


EMPTY = torch.zeros(0, 4)


def test_absurd_sizes_of_torchvision_are_refused_before_they_take_memory() -> None:
    with pytest.raises(ConfigurationError, match="with 1,501 classes computes too much"):
        replace(PLAN, classes=[str(number) for number in range(1501)])
    with torch.device("meta"):
        detector = ImportedDetector("mine", replace(PLAN, image_scale=20.0))
        with pytest.raises(ConfigurationError, match="7680 x 7680 px, 20 times as large as given"):
            detector.detect(torch.zeros(1, 3, 384, 384))
