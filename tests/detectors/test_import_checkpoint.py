"""A checkpoint file becomes a detector folder, or one clear sentence."""

from __future__ import annotations

import copy
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from detector_images import bar_images, needs_yolo, rt_detr_plan
from safetensors.torch import load_file, save_file
from torchvision.models.detection import (
    MaskRCNN,
    fasterrcnn_mobilenet_v3_large_fpn,
    maskrcnn_resnet50_fpn,
)
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import read_card
from skyproof.detectors.import_checkpoint import (
    Checkpoint,
    import_detector,
    read_blueprint,
    read_network,
)
from skyproof.detectors.loaded import build_detector, load_detector
from skyproof.detectors.ultralytics_detectors import _quiet_import
from skyproof.detectors.validation import validate
from skyproof.errors import ConfigurationError, RunFolderError, SkyproofError, StoredFileError

SMALL = "fasterrcnn_mobilenet_v3_large_fpn"
VALIDATION = bar_images(3, seed=1)
IMAGES = torch.stack(VALIDATION.images(range(len(VALIDATION)))).float() / 255


@pytest.fixture(scope="module")
def network() -> torch.nn.Module:
    """Untrained: of its hundred boxes an image some lie on vehicles."""
    torch.manual_seed(0)
    return fasterrcnn_mobilenet_v3_large_fpn(
        weights=None, weights_backbone=None, num_classes=4
    ).eval()


@pytest.fixture
def checkpoint(network: torch.nn.Module, tmp_path: Path) -> Checkpoint:
    torch.save({"model": network.state_dict(), "epoch": 7}, tmp_path / "vehicles.pth")
    return Checkpoint(tmp_path / "vehicles.pth", "torchvision", ("3", "1"), SMALL)


@pytest.fixture(scope="module")
def stored(network: torch.nn.Module, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector folder; not to be changed."""
    folder = tmp_path_factory.mktemp("stored")
    torch.save({"model": network.state_dict(), "epoch": 7}, folder / "vehicles.pth")
    card = import_detector(
        Checkpoint(folder / "vehicles.pth", "torchvision", ("3", "1"), SMALL),
        VALIDATION,
        folder / "out",
    )
    assert card == read_card(folder / "out")
    return folder / "out"


def test_a_torchvision_checkpoint(stored: Path, network: torch.nn.Module) -> None:
    assert sorted(path.name for path in stored.iterdir()) == [
        "detector.json",
        "weights.safetensors",
    ]
    detector = load_detector(stored)
    card = read_card(stored)
    assert (card.name, card.size, card.gsd_m, card.image_size_px) == (
        "out",  # The folder's, where no name is given.
        "brought",
        0.125,
        (96, 96),
    )
    assert card.trained_on == "elsewhere: torchvision checkpoint vehicles.pth"
    found = {**card.validation, "threshold": card.threshold}
    assert found == pytest.approx(validate(detector, VALIDATION))
    assert found["f1"] > 0
    assert card.validation_vehicles == sum(map(len, VALIDATION.boxes))
    state = {f"network.model.{name}": tensor for name, tensor in network.state_dict().items()}
    weights = load_file(stored / "weights.safetensors")
    assert weights.keys() == state.keys()
    assert all(torch.equal(weights[name], state[name]) for name in state)
    assert card.brought is not None
    assert card.brought.vehicle_classes == [3, 1]


def test_every_form_of_the_same_weights_gives_the_same_detector(
    checkpoint: Checkpoint, stored: Path, network: torch.nn.Module, tmp_path: Path
) -> None:
    plain = {
        name: tensor
        for name, tensor in network.state_dict().items()
        if "num_batches_tracked" not in name
    }
    save_file(plain, tmp_path / "a.safetensors")
    torch.save(network, tmp_path / "b.pt")
    wanted = read_card(stored)
    for name in ("a.safetensors", "b.pt"):
        card = import_detector(
            replace(checkpoint, path=tmp_path / name),
            VALIDATION,
            tmp_path / f"out-{name}",
            name="v",
        )
        assert card.validation == wanted.validation


@pytest.mark.parametrize(
    ("wrap", "said"),
    [
        (lambda state: {"state_dict": begun("model.", state)}, ""),
        (lambda state: {"state_dict": begun("net._orig_mod.module.model.", state)}, ""),
        (lambda state: {"ema": {"module": state, "updates": 7}}, ""),
        (
            lambda state: {"model": spoilt(state), "ema": {"module": state, "updates": 7}},
            ", the weights at 'ema.module', not those at 'model'",
        ),
        (
            lambda state: begun("model.", spoilt(state)) | begun("ema_model.module.", state),
            ", without 330 tensors beside the network",
        ),
        (
            lambda state: begun("model.", state) | {"loss.weight": torch.ones(3)},
            ", without 1 tensors beside the network",
        ),
    ],
)
def test_wrappings_of_programs_that_train(
    checkpoint: Checkpoint, network: torch.nn.Module, wrap: Any, said: str
) -> None:
    state = network.state_dict()
    torch.save(wrap(state), checkpoint.path)
    _, found, origin = read_blueprint(checkpoint, 1.0)
    assert found.keys() == state.keys()
    assert all(torch.equal(found[name], state[name]) for name in state)
    assert origin == f"torchvision checkpoint vehicles.pth{said}"


def test_a_mask_rcnn_is_imported_without_its_masks(tmp_path: Path) -> None:
    torch.manual_seed(0)
    backbone = resnet_fpn_backbone(backbone_name="resnet18", weights=None)
    network = MaskRCNN(backbone, 2).eval()
    path = tmp_path / "cars.pth"
    torch.save({"model": network.state_dict()}, path)
    asked = Checkpoint(path, "torchvision", ("1",), "maskrcnn_resnet18_fpn")
    plan, state, origin = read_blueprint(asked, 1.0)
    masks = [name for name in network.state_dict() if ".mask_" in name]
    assert masks
    assert state.keys() == network.state_dict().keys() - {*masks}
    assert origin.endswith(f"cars.pth, without {len(masks)} tensors beside the network")
    assert plan.classes == ["0", "1"]
    with pytest.raises(ConfigurationError, match="from 1 to 1"):
        read_blueprint(replace(asked, vehicle_classes=("0",)), 1.0)


@pytest.mark.parametrize(("better", "said"), [(False, "not normalised"), (True, "normalised")])
def test_labels_tell_whether_a_network_of_torchgeo_normalises(
    checkpoint: Checkpoint,
    network: torch.nn.Module,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    better: bool,
    said: str,
) -> None:
    settings = {"model": "faster-rcnn", "backbone": "resnet18", "freeze_backbone": False}
    state = begun("model.", network.state_dict())
    torch.save({"state_dict": state, "hyper_parameters": settings}, checkpoint.path)

    def ap(detector: Any, images: Dataset) -> dict[str, float]:
        assert images is VALIDATION
        return {"ap_centre_1m": 0.6 if detector.network.normalised == better else 0.5}

    monkeypatch.setattr("skyproof.detectors.import_checkpoint.validate", ap)
    card = import_detector(checkpoint, VALIDATION, tmp_path / "out")
    assert card.trained_on.endswith(f"vehicles.pth, colours {said}, as labels suggest")
    loaded: Any = load_detector(tmp_path / "out")
    assert loaded.network.normalised is better
    assert validate(loaded, VALIDATION)["f1"] == pytest.approx(card.validation["f1"])


def begun(prefix: str, state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {prefix + name: value for name, value in state.items()}


def spoilt(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value + 1 for name, value in state.items()}


def test_the_resolution_it_was_made_for(checkpoint: Checkpoint, tmp_path: Path) -> None:
    card = import_detector(replace(checkpoint, gsd_m=0.0625), VALIDATION, tmp_path / "out")
    detector = load_detector(tmp_path / "out")
    assert card.gsd_m == 0.125
    shown: list[torch.Size] = []
    model: Any = detector.network.model  # type: ignore[union-attr]
    model.backbone.register_forward_pre_hook(lambda _, given: shown.append(given[0].shape))
    detector.detect(IMAGES)
    assert shown == [torch.Size([3, 3, 192, 192])]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": None}, "--architecture"),
        ({"architecture": "ssd300_vgg16"}, "fcos_resnet50_fpn"),
        ({"architecture": "fasterrcnn_resnet50_fpn"}, "tensors differ, such as"),
        ({"architecture": "retinanet_resnet50_fpn"}, "do not fit retinanet"),
        ({"vehicle_classes": ("4",)}, "from 1 to 3"),
        ({"vehicle_classes": ("0",)}, "from 1 to 3"),
        ({"vehicle_classes": ("car",)}, "keeps no names"),
        ({"vehicle_classes": ()}, "got none"),
        ({"gsd_m": 0.0}, "--gsd"),
        ({"gsd_m": 1000.0}, "--gsd expects a number from 0.001 up to 100"),
        ({"gsd_m": float("inf")}, "--gsd expects a number"),
        ({"gsd_m": 100.0}, "out of reason"),
        ({"kind": "detectron2"}, "detectron2"),
        ({"kind": "ultralytics"}, "leave --architecture out"),
        (
            {"kind": "ultralytics", "architecture": None},
            "holds a state dict, not a detection network",
        ),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(
    checkpoint: Checkpoint, change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SkyproofError, match=message):
        import_detector(replace(checkpoint, **change), VALIDATION, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["vehicles.pth"]


def test_other_files_names_and_images(checkpoint: Checkpoint, tmp_path: Path) -> None:
    for name in ("a b", "", "../x", "mean"):
        with pytest.raises(ConfigurationError, match="choose another name"):
            import_detector(checkpoint, VALIDATION, tmp_path / "out", name=name)
    (tmp_path / "text.pt").write_text("not weights")
    # Nor is a file a folder that is damaged.
    with pytest.raises(StoredFileError, match="is a file and no detector folder; make one"):
        load_detector(tmp_path / "text.pt")
    torch.save({"epoch": 3}, tmp_path / "empty.pt")
    torch.save(
        maskrcnn_resnet50_fpn(weights=None, weights_backbone=None).roi_heads.state_dict(),
        tmp_path / "mask.pt",
    )
    for name, error, message in (
        ("text.pt", StoredFileError, "not a checkpoint"),
        ("none.pt", StoredFileError, "missing"),
        ("empty.pt", StoredFileError, "no weights"),
        ("mask.pt", ConfigurationError, "do not fit"),
    ):
        with pytest.raises(error, match=message):
            import_detector(replace(checkpoint, path=tmp_path / name), VALIDATION, tmp_path / "out")
    empty = bar_images(1, seed=0)
    with pytest.raises(ConfigurationError, match="at least one vehicle"):
        import_detector(checkpoint, empty, tmp_path / "out")
    (tmp_path / "out").mkdir()
    with pytest.raises(RunFolderError, match="not overwritten"):
        import_detector(checkpoint, VALIDATION, tmp_path / "out")


def test_a_detector_that_finds_nothing_is_not_imported(
    checkpoint: Checkpoint, network: torch.nn.Module, tmp_path: Path
) -> None:
    state = copy.deepcopy(network.state_dict())
    # Far above the vehicle classes: everything is background.
    state["roi_heads.box_predictor.cls_score.bias"][0] = 50.0
    torch.save(state, checkpoint.path)
    with pytest.raises(
        ConfigurationError, match=r"(?s)none of the \d+ labelled vehicles.*--vehicle-classes.*--gsd"
    ):
        import_detector(checkpoint, VALIDATION, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": "ssd"}, "no detector of kind 'torchvision' is called 'ssd'"),
        ({"vehicle_classes": [9]}, "class 9 is not among 4"),
        ({"vehicle_classes": []}, r"brought\.vehicle_classes: expected a list of length >= 1"),
        ({"colour": "red"}, r"brought: there is no field 'colour'"),
        ({"classes": ["0", "1"]}, "class 3 is not among 2"),
        ({"classes": ["x"] * 10**5}, r"brought\.classes: expected a list of length <= 5000"),
        ({"image_scale": 1e300}, r"brought\.image_scale: expected a number <= 20"),
        ({"classes": ["0", "1", "2", "3", "4"]}, "does not fit"),
    ],
)
def test_a_garbled_folder_is_refused(
    stored: Path, change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(stored, tmp_path / "out")) / "detector.json"
    record = json.loads(path.read_text())
    record["brought"] |= change
    path.write_text(json.dumps(record))
    with pytest.raises(StoredFileError, match=message):
        load_detector(tmp_path / "out")


def stored_by_ultralytics(path: Path, file: str, names: list[str]) -> Any:
    """A network of a YAML file, stored as Ultralytics does: a pickled object, in halves."""
    with _quiet_import():
        from ultralytics import RTDETR, YOLO

        yolo = (RTDETR if "rtdetr" in file else YOLO)(file)
    yolo.model.names = dict(enumerate(names))
    yolo.model.float().eval()
    # As its trainer does.
    yolo.ckpt = {"train_args": {"imgsz": 768}}
    yolo.save(str(path))
    return yolo.model


@needs_yolo
@pytest.mark.parametrize(
    "file",
    ["yolov5n.yaml", "yolov8n.yaml", "yolo11n.yaml", "yolov8n-obb.yaml", "yolo11n-seg.yaml"],
)
def test_an_ultralytics_checkpoint(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An untrained network's few boxes hit nothing but by luck.
    scores = {"ap_centre_1m": 0.5, "ap_iou_50": 0.4, "f1": 0.6, "threshold": 0.3}
    monkeypatch.setattr("skyproof.detectors.validation._scores", lambda *_: dict(scores))
    torch.manual_seed(0)
    count = 15 if "obb" in file else 80
    names = [f"class {index}" for index in range(count - 2)] + ["small vehicle", "truck"]
    theirs = stored_by_ultralytics(tmp_path / "best.pt", file, names)
    checkpoint = Checkpoint(tmp_path / "best.pt", "ultralytics", ("truck", "small vehicle"))
    card = import_detector(checkpoint, VALIDATION, tmp_path / "out", name="yolo8")
    loaded = load_detector(tmp_path / "out")
    assert card == loaded.card
    assert card.brought is not None
    assert card.brought.vehicle_classes == [count - 1, count - 2]
    assert card.brought.classes == names
    assert card.brought.side_px == loaded.window_px == 768
    assert {**card.validation, "threshold": card.threshold} == scores
    decoded = theirs.half().float()(IMAGES)[0]
    decoded = decoded[0] if "seg" in file else decoded
    wanted = decoded[:, [4 + count - 1, 4 + count - 2]].amax(dim=1)
    torch.testing.assert_close(loaded.candidates(IMAGES).scores, wanted, rtol=1e-3, atol=1e-5)
    with pytest.raises(ConfigurationError, match=r"small vehicle, truck; got boat"):
        import_detector(
            replace(checkpoint, vehicle_classes=("boat",)), VALIDATION, tmp_path / "other"
        )


@needs_yolo
def test_an_rt_detr_of_ultralytics(tmp_path: Path) -> None:
    plan = rt_detr_plan([0])
    (tmp_path / "rtdetr-thin.yaml").write_text(json.dumps(plan.architecture))
    names = ["car", "van", "boat"]
    theirs = stored_by_ultralytics(tmp_path / "best.pt", str(tmp_path / "rtdetr-thin.yaml"), names)
    checkpoint = Checkpoint(tmp_path / "best.pt", "ultralytics", ("boat", "van"))
    detector, blueprint, _ = read_network(checkpoint, 1.0, "mine")
    assert (blueprint.classes, blueprint.side_px, blueprint.trainable) == (names, 768, True)
    assert detector.window_px == 768
    images = torch.rand(1, 3, 768, 768, generator=torch.Generator().manual_seed(0))
    answers = theirs.half().float()(images)[1][1][-1]
    wanted = answers[0, :, 1:].amax(dim=1).sigmoid()
    found = detector.eval().candidates(images).scores[0]
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4)


@needs_yolo
def test_other_networks_of_ultralytics_are_refused(tmp_path: Path) -> None:
    for file, kind in (
        ("yolov8n-pose.yaml", "PoseModel"),
        ("yolov8n-cls.yaml", "ClassificationModel"),
    ):
        stored_by_ultralytics(tmp_path / "x.pt", file, ["car"])
        with pytest.raises(StoredFileError, match=f"{kind}, not a detection network"):
            import_detector(
                Checkpoint(tmp_path / "x.pt", "ultralytics", ("car",)), VALIDATION, tmp_path / "out"
            )


@needs_yolo
def test_missing_extra_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored_by_ultralytics(tmp_path / "x.pt", "yolov8n.yaml", ["car"] * 80)
    for name in [name for name in sys.modules if name.split(".")[0] == "ultralytics"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(ConfigurationError, match=r"skyproof\[yolo\]"):
        import_detector(
            Checkpoint(tmp_path / "x.pt", "ultralytics", ("car",)), VALIDATION, tmp_path / "out"
        )


def test_folders_of_before_say_nothing_of_their_training_images(tmp_path: Path) -> None:
    from test_loaded import CARD

    from skyproof.detectors.loaded import save_detector

    save_detector(
        tmp_path,
        build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(1)),
        CARD,
    )
    record = json.loads((tmp_path / "detector.json").read_text())
    del record["trained_on"], record["brought"]
    (tmp_path / "detector.json").write_text(json.dumps(record))
    assert read_card(tmp_path) == CARD
    assert load_detector(tmp_path).card.trained_on == ""


def test_images_of_different_sizes_are_validated(checkpoint: Checkpoint, tmp_path: Path) -> None:
    large = bar_images(3, 128, seed=5)
    mixed = Dataset.joined([VALIDATION, large])
    assert import_detector(checkpoint, mixed, tmp_path / "out").validation["f1"] > 0
