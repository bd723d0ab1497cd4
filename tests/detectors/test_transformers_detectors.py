"""Folders of transformers: the library's own detections and losses, and nothing of theirs runs."""

from __future__ import annotations

import importlib.util
import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from detector_images import bar_images
from safetensors.torch import load_file, save_file
from tests.transformers_folders import CLASSES, FAMILIES, SIDE_PX, needs_transformers, write_folder
from torchvision.ops import box_convert, clip_boxes_to_image

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import detector_folder, read_card
from skyproof.detectors.import_checkpoint import Checkpoint, import_detector, kind_of, read_network
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ConfigurationError, SkyproofError

LABELLED = bar_images(3, size_px=SIDE_PX, seed=1)
IMAGES = torch.stack(LABELLED.images(range(len(LABELLED)))).float() / 255
NOTHING = [torch.zeros(0, 4)] * len(IMAGES)
pytestmark = needs_transformers


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a connection")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def checkpoint_of(folder: Path, *vehicle_classes: str) -> Checkpoint:
    return Checkpoint(folder / "model.safetensors", "transformers", vehicle_classes)


def read(folder: Path, *vehicle_classes: str) -> ImportedDetector:
    detector, _, _ = read_network(checkpoint_of(folder, *vehicle_classes), 1.0, "mine")
    return detector.eval().requires_grad_(False)


@pytest.mark.parametrize("family", FAMILIES)
def test_detections_are_those_of_the_library(family: str, tmp_path: Path) -> None:
    write_folder(tmp_path, family, ["car"])
    detector = read(tmp_path, "car")
    from transformers import AutoImageProcessor, AutoModelForObjectDetection

    network = AutoModelForObjectDetection.from_pretrained(tmp_path).eval()
    processor = AutoImageProcessor.from_pretrained(tmp_path)
    for picture in LABELLED.images(range(3)):
        (found,) = detector.detect(picture[None].float() / 255)
        with torch.no_grad():
            answers = network(**processor(images=[picture], return_tensors="pt"))
        (wanted,) = processor.post_process_object_detection(
            answers, threshold=0.0, target_sizes=[(SIDE_PX, SIDE_PX)]
        )
        boxes = clip_boxes_to_image(wanted["boxes"], (SIDE_PX, SIDE_PX))
        # DETR's answers are not sorted.
        scores, order = wanted["scores"].sort(descending=True)
        torch.testing.assert_close(found.scores, scores, rtol=0, atol=1e-3)
        torch.testing.assert_close(found.boxes, boxes[order], rtol=0, atol=0.5)
        # Queries answer without suppression.
        assert len(found.scores) == 30


@pytest.mark.parametrize("family", FAMILIES)
def test_an_empty_truth_costs_what_the_library_says(family: str, tmp_path: Path) -> None:
    network = write_folder(tmp_path, family)
    detector = read(tmp_path, *CLASSES)
    ours = detector.loss(IMAGES, NOTHING)
    truth = {"class_labels": torch.zeros(0, dtype=torch.int64), "boxes": torch.zeros(0, 4)}
    mean, deviation = detector.network.colours
    for image, loss in zip(IMAGES, ours, strict=True):
        seen = (image - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(deviation).view(3, 1, 1)
        with torch.no_grad():
            terms = network(pixel_values=seen[None], labels=[truth]).loss_dict
        # DETR averages over its 30 queries.
        wanted = next(terms[name] for name in ("loss_vfl", "loss_mal", "loss_ce") if name in terms)
        torch.testing.assert_close(loss, wanted * (30 if family == "detr" else 1))


@pytest.mark.parametrize("family", FAMILIES)
def test_the_loss_falls_along_its_gradient(family: str, tmp_path: Path) -> None:
    write_folder(tmp_path, family)
    # A larger step, or rounding, would let other queries answer; and pixels alike have two slopes
    # where the larger one passes.
    detector = read(tmp_path, "car", "van").double()
    noise = torch.rand(IMAGES.shape, generator=torch.Generator().manual_seed(0))
    images = (0.9 * IMAGES + 0.1 * noise).double().requires_grad_()
    losses = detector.loss(images, NOTHING)
    losses.sum().backward()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    norm = float(images.grad.norm())
    with torch.no_grad():
        moved = detector.loss(images - 1e-6 / norm * images.grad, NOTHING)
        change = float((moved - losses).sum())
    assert norm > 0
    assert change == pytest.approx(-1e-6 * norm, rel=0.05)


@pytest.mark.parametrize("family", FAMILIES)
def test_vehicles_cost_what_the_library_says_and_are_learnt(family: str, tmp_path: Path) -> None:
    network = write_folder(tmp_path, family, ["car"], fresh=True)
    detector = read(tmp_path, "car").requires_grad_(True)
    boxes = LABELLED.boxes[2]
    mean, deviation = detector.network.colours
    seen = (IMAGES[2] - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(deviation).view(3, 1, 1)
    truth = {
        "class_labels": torch.zeros(len(boxes), dtype=torch.int64),
        "boxes": box_convert(boxes / SIDE_PX, "xyxy", "cxcywh"),
    }
    with torch.no_grad():
        wanted = network(pixel_values=seen[None], labels=[truth]).loss
    losses = detector.train().loss(IMAGES, LABELLED.boxes)
    torch.testing.assert_close(losses[2].detach(), wanted, rtol=1e-4, atol=1e-4)
    # An image without vehicles keeps its own loss among others.
    assert not len(LABELLED.boxes[0])
    torch.testing.assert_close(losses[0], detector.loss(IMAGES[:1], NOTHING[:1])[0])
    # Along the gradient of the weights the loss falls.
    losses.sum().backward()
    gradients = [each.grad for each in detector.parameters() if each.grad is not None]
    norm = torch.stack([each.norm() for each in gradients]).norm()
    with torch.no_grad():
        for parameter in detector.parameters():
            if parameter.grad is not None:
                parameter -= 1e-5 / norm * parameter.grad
    assert detector.loss(IMAGES, LABELLED.boxes).sum() < losses.sum()


def test_the_likeliest_vehicle_class_is_learnt(tmp_path: Path) -> None:
    write_folder(tmp_path, "rt_detr")
    detector = read(tmp_path, "car", "boat")
    with torch.no_grad():
        answers = detector.network.model(pixel_values=IMAGES[:1])
    best = int(answers.logits[0, :, 2].argmax())
    box = box_convert(answers.pred_boxes[0, best : best + 1], "cxcywh", "xyxy")
    likeliest = [0, 2][int(answers.logits[0, best, 2] > answers.logits[0, best, 0])]
    assert detector.network._likeliest(IMAGES[:1], box).tolist() == [likeliest]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_stored_detector_is_the_same(family: str, tmp_path: Path) -> None:
    write_folder(tmp_path / "theirs", family)
    # The labels of a random network are the boxes that it finds.
    wanted = read(tmp_path / "theirs", "car").detect(IMAGES)
    found_px = [detections.boxes[:2] for detections in wanted]
    labelled = Dataset.of_images(LABELLED.images(range(3)), found_px, gsd_m=0.125)
    card = import_detector(checkpoint_of(tmp_path / "theirs", "car"), labelled, tmp_path / "ours")
    assert card == read_card(tmp_path / "ours")
    assert card.trainable
    assert card.brought is not None
    assert (card.brought.classes, card.brought.side_px) == (CLASSES, SIDE_PX)
    again = load_detector(tmp_path / "ours")
    found = again.detect(IMAGES)
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one.scores, other.scores)
        assert torch.equal(one.boxes, other.boxes)
    others = again.of_other_classes()
    assert others is not None
    assert not torch.equal(others.detect(IMAGES)[0].scores, found[0].scores)
    levels, width = again.pyramid(IMAGES)
    assert width == SIDE_PX
    assert [level.shape[0] for level in levels] == [len(IMAGES)] * len(levels)


def test_small_images_are_seen_in_a_frame_as_large_as_in_training(tmp_path: Path) -> None:
    # Boxes are shares of the image's sides, so a smaller image would shrink them.
    write_folder(tmp_path, "rt_detr")
    detector = read(tmp_path, "car")
    framed = torch.full((1, 3, SIDE_PX, SIDE_PX), 0.45)
    framed[..., :100, :110] = IMAGES[:1, :, :100, :110]
    small = detector.candidates(IMAGES[:1, :, :100, :110])
    assert torch.equal(small.boxes, detector.candidates(framed).boxes)
    assert detector.window_px == 192


def test_sides_are_multiples_of_patches_and_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, settings, backbone = FAMILIES["rf_detr"]
    own = backbone | {"patch_size": 14, "image_size": 140}
    monkeypatch.setitem(FAMILIES, "rf_detr", (name, settings, own))
    write_folder(tmp_path, "rf_detr")
    detector = read(tmp_path, "car")
    seen, _ = detector.network._seen(IMAGES)
    assert seen.shape[-2:] == (140, 140)
    framed = torch.full((1, 3, 140, 140), 0.45)
    framed[..., :SIDE_PX, :SIDE_PX] = IMAGES[:1]
    assert torch.equal(detector.candidates(IMAGES[:1]).boxes, detector.candidates(framed).boxes)


def changed(name: str, **fields: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        stored = json.loads((folder / name).read_text())
        for field, value in fields.items():
            if value is None:
                del stored[field]
            else:
                stored[field] = value
        (folder / name).write_text(json.dumps(stored))

    return change


def of_network(**fields: Any) -> Callable[[Path], None]:
    return changed("config.json", **fields)


def of_processor(**fields: Any) -> Callable[[Path], None]:
    return changed("preprocessor_config.json", **fields)


def without_a_tensor(folder: Path) -> None:
    state = load_file(folder / "model.safetensors")
    state.pop("model.encoder_input_proj.0.0.weight")
    save_file(state, folder / "model.safetensors")


def test_a_backbone_from_a_hub_is_refused(tmp_path: Path) -> None:
    write_folder(tmp_path, "detr")
    of_network(backbone_config=None, backbone="hf_hub:someone/something")(tmp_path)
    with pytest.raises(ConfigurationError, match="'hf_hub:someone/something' of timm, expected"):
        read(tmp_path, "car")


def test_a_network_that_computes_without_bound_is_refused(tmp_path: Path) -> None:
    write_folder(tmp_path, "d_fine")
    backbone = json.loads((tmp_path / "config.json").read_text())["backbone_config"]
    of_network(backbone_config={**backbone, "stem_strides": [1] * 5})(tmp_path)
    with pytest.raises(ConfigurationError, match="finer than every 4 px"):
        read(tmp_path, "car")


@pytest.mark.parametrize(
    ("family", "fields", "said"),
    [
        ("rf_detr", {"num_windows": 100}, "no detector needs patches or windows"),
        ("rf_detr", {"patch_size": [16, 16]}, "cannot build the network"),
        ("lw_detr", {"num_windows": 2**16}, "cannot build the network"),
        ("lw_detr", {"num_windows": 0}, "cannot build the network"),
        ("deimv2", {"model_type": "rt_detr_resnet"}, "a deimv2 on a rt_detr_resnet"),
    ],
)
def test_bad_backbones_are_one_sentence(
    family: str, fields: dict[str, Any], said: str, tmp_path: Path
) -> None:
    write_folder(tmp_path, family)
    backbone = json.loads((tmp_path / "config.json").read_text())["backbone_config"]
    of_network(backbone_config=backbone | fields)(tmp_path)
    with pytest.raises(ConfigurationError, match=said):
        read(tmp_path, "car")


def test_the_programs_own_hub_is_as_before(tmp_path: Path) -> None:
    from huggingface_hub import constants

    write_folder(tmp_path, "detr")
    before = constants.HF_HUB_OFFLINE
    read(tmp_path, "car")
    assert before == constants.HF_HUB_OFFLINE


def test_larger_images_than_in_training_are_shown_in_windows(tmp_path: Path) -> None:
    write_folder(tmp_path, "rt_detr")
    detector = read(tmp_path, "car")
    sides: list[torch.Size] = []
    detect = detector.detect
    detector.detect = lambda images: (sides.append(images.shape[-2:]), detect(images))[1]  # type: ignore[method-assign,func-returns-value]
    large = torch.rand(2, 3, 200, 300, generator=torch.Generator().manual_seed(0))
    pictures = [*(large * 255).to(torch.uint8)]
    detect_all(detector, Dataset.of_images(pictures, [torch.zeros(0, 4)] * 2, gsd_m=0.125))
    assert len(sides) == 2
    assert all(max(side) <= detector.window_px == 192 for side in sides)


def test_classes_of_one_name_are_all_taken(tmp_path: Path) -> None:
    write_folder(tmp_path, "rt_detr")
    of_network(id2label={"0": "car", "1": "van", "2": "car"})(tmp_path)
    assert read(tmp_path, "car", "car").network.vehicle_classes == [0, 2]


def test_weights_of_torch_save_are_taken(tmp_path: Path) -> None:
    write_folder(tmp_path, "rt_detr")
    wanted = read(tmp_path, "car").detect(IMAGES)
    state = load_file(tmp_path / "model.safetensors")
    torch.save(
        {name: each for name, each in state.items() if not name.endswith("num_batches_tracked")},
        tmp_path / "pytorch_model.bin",
    )
    (tmp_path / "model.safetensors").unlink()
    path = detector_folder(tmp_path)
    assert path.name == "pytorch_model.bin"
    assert kind_of(path, None) == "transformers"
    detector, _, origin = read_network(Checkpoint(path, "transformers", ("car",)), 1.0, "mine")
    assert origin == f"transformers checkpoint {tmp_path.name}"
    found = detector.eval().detect(IMAGES)
    assert torch.equal(found[0].scores, wanted[0].scores)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (of_network(model_type="yolos"), "is a yolos on a rt_detr_resnet, expected one of rt_detr"),
        (of_network(model_type=None), "the field model_type is missing"),
        (of_network(id2label={"0": "car", "5": "van"}), "does not name its classes 0 to 1"),
        (of_network(id2label={"0": "car", "1": "van"}), "do not fit its config.json"),
        (of_network(d_model=64), "do not fit its config.json"),
        (of_network(d_model=10**9), "of transformers"),
        (of_network(decoder_layers=60_000), "would take more than"),
        (of_network(activation_function="sigh"), "cannot build the network"),
        (of_network(backbone_config={"model_type": "dinov2"}), "is a rt_detr on a dinov2"),
        # These would ask the hub for a backbone of timm.
        (of_network(backbone_config=None), "is a rt_detr on a timm_backbone"),
        (of_network(backbone_config=None, backbone="resnet18"), "on a timm_backbone"),
        (of_network(num_queries=60_000), "cannot build the network (selected index k"),
        (of_network(encoder_attention_heads=5), "check its config.json"),
        (of_network(initializer_range=-1.0), "cannot build the network"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), "config.json is missing"),
        (of_processor(image_processor_type="YolosImageProcessor"), "'YolosImageProcessor'"),
        (of_processor(size={"height": 128, "width": 256}), "a square or a shortest edge"),
        (of_processor(do_rescale=False), "does not bring colours from 255 to 1"),
        (of_processor(do_normalize=True, image_std=[0, 1, 1]), "image_std"),
        (without_a_tensor, "1 tensors differ, such as model.encoder_input_proj.0.0.weight"),
    ],
)
def test_bad_folders_are_one_sentence(
    change: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    write_folder(tmp_path, "rt_detr")
    change(tmp_path)
    with pytest.raises(SkyproofError) as refusal:
        read(tmp_path, "car")
    sentence = str(refusal.value)
    assert said in sentence
    assert "\n" not in sentence
    assert sentence.count(". ") == 0


def test_fields_that_name_code_are_left_out(tmp_path: Path) -> None:
    write_folder(tmp_path, "rt_detr")
    wanted = read(tmp_path, "car").detect(IMAGES)
    of_network(
        auto_map={"AutoConfig": "evil--configuration.Evil"},
        _attn_implementation="someone/kernels",
        attn_implementation="someone/kernels",
        quantization_config={"quant_method": "bitsandbytes"},
        use_pretrained_backbone=True,
        _name_or_path="someone/something",
    )(tmp_path)
    (tmp_path / "configuration.py").write_text("raise SystemExit")
    detector = read(tmp_path, "car")
    for one, other in zip(wanted, detector.detect(IMAGES), strict=True):
        assert torch.equal(one.scores, other.scores)
    configuration = detector.network.model.config
    assert configuration._attn_implementation in ("sdpa", "eager")
    assert not hasattr(configuration, "auto_map")


@pytest.mark.skipif(importlib.util.find_spec("timm") is None, reason="timm is not installed")
def test_a_backbone_of_timm_as_transformers_4_names_it(tmp_path: Path) -> None:
    import transformers

    configuration = transformers.DetrConfig(
        **FAMILIES["detr"][1], backbone="resnet18", id2label={0: "car"}, label2id={"car": 0}
    )
    network = transformers.DetrForObjectDetection(configuration).eval()
    network.save_pretrained(tmp_path)
    side = {"height": SIDE_PX, "width": SIDE_PX}
    transformers.DetrImageProcessor(size=side).save_pretrained(tmp_path)
    of_network(
        backbone_config=None,
        backbone="resnet18",
        use_timm_backbone=True,
        use_pretrained_backbone=True,
    )(tmp_path)
    of_processor(image_processor_type=None, feature_extractor_type="DetrFeatureExtractor")(tmp_path)
    detector = read(tmp_path, "car")
    seen, _ = detector.network._seen(IMAGES)
    with torch.no_grad():
        wanted = network(pixel_values=seen).logits
        assert torch.equal(detector.network.model(pixel_values=seen).logits, wanted)


def test_the_kind_is_told_by_the_files_beside(tmp_path: Path) -> None:
    write_folder(tmp_path, "detr")
    weights = tmp_path / "model.safetensors"
    assert kind_of(weights, None) == "transformers"
    # DeepForest, too, writes a config.json beside its RetinaNet.
    assert kind_of(weights, "retinanet_resnet50_fpn") == "torchvision"
    assert kind_of(tmp_path.parent / "best.pt", None) == "ultralytics"
    # Any program may write a config.json.
    assert kind_of(tmp_path / "best.pt", None) == "ultralytics"


def test_missing_extra_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_folder(tmp_path, "detr")
    monkeypatch.setitem(sys.modules, "transformers.utils", None)
    with pytest.raises(ConfigurationError, match=r'pip install "skyproof\[transformers\]"'):
        read(tmp_path, "car")
