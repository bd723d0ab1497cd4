"""Checkpoints of rfdetr: the same network as in transformers, and nothing in the file runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pytest
import torch
from detector_images import bar_images
from tests.transformers_folders import CLASSES, SIDE_PX, needs_transformers, write_folder
from torch import Tensor

from skyproof.detectors.import_checkpoint import Checkpoint, import_detector, read_network
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.loaded import load_detector
from skyproof.errors import SkyproofError

LABELLED = bar_images(3, size_px=SIDE_PX, seed=1)
IMAGES = torch.stack(LABELLED.images(range(len(LABELLED)))).float() / 255
pytestmark = needs_transformers

NOTED = {
    "resolution": SIDE_PX,
    "sa_nheads": 2,
    "ca_nheads": 4,
    "dec_n_points": 2,
    "out_feature_indexes": [2, 4],
    "num_windows": 2,
    "class_names": CLASSES[:2],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("rf_detr")
    # rfdetr has a class beyond the named ones.
    write_folder(place, "rf_detr", CLASSES, layer_norm_eps=1e-6)
    return place


@pytest.fixture(scope="module")
def weights(folder: Path) -> dict[str, Tensor]:
    from safetensors.torch import load_file

    # transformers stores them under rfdetr's names.
    state: dict[str, Tensor] = load_file(folder / "model.safetensors")
    return state | {"_kp_active_mask": torch.zeros(1)}


def read(path: Path, *vehicle_classes: str, **asked: Any) -> ImportedDetector:
    checkpoint = Checkpoint(path, asked.pop("kind", "transformers"), vehicle_classes, **asked)
    detector, _, _ = read_network(checkpoint, 1.0, "mine")
    return detector.eval().requires_grad_(False)


def test_it_is_the_network_of_transformers(
    folder: Path, weights: dict[str, Tensor], tmp_path: Path
) -> None:
    wanted = read(folder / "model.safetensors", "car").detect(IMAGES)
    files = {
        "old": {"model": weights, "args": argparse.Namespace(**NOTED), "model_config": {"lr": 1}},
        "new": {"model": weights, "args": {"lr": 1e-4}, "model_config": NOTED},
        "lightning": {
            "state_dict": {f"model.{name}": each for name, each in weights.items()},
            "args": NOTED,
            "model_config": NOTED,
        },
    }
    for name, content in files.items():
        torch.save(content, tmp_path / f"{name}.pth")
        # `assess` asks for no kind.
        for kind in ("transformers", "ultralytics"):
            found = read(tmp_path / f"{name}.pth", "car", kind=kind).detect(IMAGES)
            for one, other in zip(found, wanted, strict=True):
                assert len(one.scores)
                assert torch.equal(one.scores, other.scores)
                assert torch.equal(one.boxes, other.boxes)


def test_it_is_stored_as_any_other(
    folder: Path, weights: dict[str, Tensor], tmp_path: Path
) -> None:
    torch.save({"model": weights, "model_config": NOTED}, tmp_path / "best.pth")
    checkpoint = Checkpoint(tmp_path / "best.pth", "transformers", ("car", "van"))
    boxes = [found.boxes[:2] for found in read(checkpoint.path, "car", "van").detect(IMAGES)]
    labelled = type(LABELLED).of_images(LABELLED.images(range(3)), boxes, gsd_m=0.125)
    card = import_detector(checkpoint, labelled, tmp_path / "mine")
    assert card.trained_on == "elsewhere: transformers checkpoint best.pth"
    assert card.brought is not None
    assert (card.brought.classes, card.brought.side_px) == (["car", "van", "2"], SIDE_PX)
    assert len(load_detector(tmp_path / "mine").detect(IMAGES)[0].scores)


def test_names_of_older_releases_are_not_taken(weights: dict[str, Tensor], tmp_path: Path) -> None:
    # rfdetr 1.2 numbers its names from row 1, so that the wrong class would be taken.
    torch.save({"model": weights, "args": argparse.Namespace(**NOTED)}, tmp_path / "best.pth")
    assert read(tmp_path / "best.pth", "1").network.vehicle_classes == [1]
    with pytest.raises(SkyproofError, match="expects names out of 0, 1, 2; got car"):
        read(tmp_path / "best.pth", "car")


def test_more_classes_than_any_detector_has_are_refused(
    weights: dict[str, Tensor], tmp_path: Path
) -> None:
    state = weights | {"class_embed.bias": torch.zeros(10**6, dtype=torch.int8)}
    torch.save({"model": state, "model_config": NOTED}, tmp_path / "best.pth")
    with pytest.raises(SkyproofError):
        read(tmp_path / "best.pth", "car")


def test_classes_without_names_are_numbers(weights: dict[str, Tensor], tmp_path: Path) -> None:
    noted = {name: value for name, value in NOTED.items() if name != "class_names"}
    torch.save({"model": weights, "args": noted}, tmp_path / "best.pth")
    assert read(tmp_path / "best.pth", "1").network.vehicle_classes == [1]
    with pytest.raises(SkyproofError, match="expects names out of 0, 1, 2; got car"):
        read(tmp_path / "best.pth", "car")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"resolution": None}, "the field resolution is missing; give checkpoint_best_ema.pth"),
        ({"resolution": 10**9}, "resolution"),
        ({"sa_nheads": 0}, "sa_nheads"),
        ({"sa_nheads": "two"}, "sa_nheads"),
        ({"sa_nheads": 5}, "do not fit the settings in it: 14 tensors differ"),
        ({"out_feature_indexes": [2, 60]}, "cannot build the network"),
        ({"out_feature_indexes": [4]}, "tensors differ"),
        ({"dec_n_points": 3}, "tensors differ"),
    ],
)
def test_bad_settings_are_one_sentence(
    change: dict[str, Any], said: str, weights: dict[str, Tensor], tmp_path: Path
) -> None:
    noted = {name: value for name, value in (NOTED | change).items() if value is not None}
    torch.save({"model": weights, "model_config": noted}, tmp_path / "best.pth")
    with pytest.raises(SkyproofError) as refusal:
        read(tmp_path / "best.pth", "car")
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("query_feat.weight", "lacks tensors of an RF-DETR that finds boxes"),
        ("class_embed.bias", "lacks tensors of an RF-DETR that finds boxes"),
        ("transformer.decoder.norm.bias", "1 tensors differ, such as model.decoder.layernorm.bias"),
    ],
)
def test_missing_tensors_are_one_sentence(
    missing: str, said: str, weights: dict[str, Tensor], tmp_path: Path
) -> None:
    rest = {name: tensor for name, tensor in weights.items() if name != missing}
    torch.save({"model": rest, "model_config": NOTED}, tmp_path / "best.pth")
    with pytest.raises(SkyproofError, match=said):
        read(tmp_path / "best.pth", "car")


def test_several_levels_are_refused(weights: dict[str, Tensor], tmp_path: Path) -> None:
    state = weights | {"backbone.0.projector.stages.1.1.weight": torch.zeros(1)}
    torch.save({"model": state, "model_config": NOTED}, tmp_path / "best.pth")
    with pytest.raises(SkyproofError, match=r"several levels, as the first Large was.*to ONNX"):
        read(tmp_path / "best.pth", "car")


def test_weights_alone_are_refused(weights: dict[str, Tensor], tmp_path: Path) -> None:
    torch.save(weights, tmp_path / "best.pth")
    with pytest.raises(SkyproofError, match="the field resolution is missing"):
        read(tmp_path / "best.pth", "car")
    with pytest.raises(SkyproofError, match="do not fit retinanet_resnet50_fpn"):
        read(tmp_path / "best.pth", "1", kind="torchvision", architecture="retinanet_resnet50_fpn")


def test_detections_are_those_of_rfdetr(tmp_path: Path) -> None:
    rfdetr = pytest.importorskip("rfdetr", reason="rfdetr is not installed")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        theirs = rfdetr.RFDETRNano(pretrain_weights=None, num_classes=2, device="cpu")
        network = theirs.model.model.eval()
        for name, parameter in network.named_parameters():
            if "class_embed" in name or "bbox_embed" in name:
                parameter.data.normal_(std=0.3 if "class" in name else 0.03)
    settings = theirs.model_config.model_dump()
    torch.save(
        {"model": network.state_dict(), "model_config": settings | {"class_names": CLASSES[:2]}},
        tmp_path / "best.pth",
    )
    side = settings["resolution"]
    image = torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))
    found = theirs.predict(image, threshold=0.0)
    ours = read(tmp_path / "best.pth", "car").candidates(image[None])
    cars = torch.from_numpy(found.class_id == 0)
    boxes, scores = torch.from_numpy(found.xyxy)[cars], torch.from_numpy(found.confidence)[cars]
    nearest = torch.cdist(boxes, ours.boxes[0].clamp(0, side)).argmin(dim=1)
    assert len(nearest) > 20
    torch.testing.assert_close(ours.boxes[0].clamp(0, side)[nearest], boxes, rtol=0, atol=0.5)
    torch.testing.assert_close(ours.scores[0, nearest], scores, rtol=0, atol=1e-3)
