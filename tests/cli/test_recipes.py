"""The recipes ask another library as it wants to be asked, and give its boxes in pixels.

Stand-ins have the interfaces of the libraries. They check the pictures that they get and find
rectangles in them: red ones are vehicles, blue ones are something else, and the brightness is the
score.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import skyproof as sp
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.checkpoints import read_checkpoint
from skyproof.detectors.import_checkpoint import Checkpoint, read_ultralytics
from skyproof.errors import DetectorAnswerError, StoredFileError

ROOT = Path(__file__).parents[2]
RECIPES = sorted((ROOT / "examples" / "recipes").glob("*.py"))
NAMES = [recipe.stem for recipe in RECIPES]
LONGEST = 15

HEIGHT, WIDTH = 96, 128
TILE, SLICE = 640, 256
GROUND = (60, 60, 60)
# Left, top, right, bottom and colour. The last vehicle is one of which a detector is unsure.
SCENES = [
    [
        ((10, 20, 50, 40), (230, 0, 0)),
        ((70, 60, 90, 90), (180, 0, 0)),
        ((100, 5, 120, 15), (0, 0, 200)),
        ((5, 70, 25, 80), (10, 0, 0)),
    ],
    [
        ((60, 8, 75, 48), (200, 0, 0)),
        ((15, 50, 45, 60), (0, 0, 150)),
        ((90, 70, 128, 96), (8, 0, 0)),
    ],
]
VEHICLE, OTHER = 0, 1
CLASSES = {VEHICLE: "car", OTHER: "shed"}


def code(recipe: Path) -> str:
    """Without the docstring."""
    return recipe.read_text(encoding="utf-8").partition('"""\n')[2].strip()


def drawn(scene: Sequence[Any], height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    """The rectangles of a scene, as a detector gets them."""
    picture = np.full((height, width, 3), GROUND, dtype=np.uint8)
    for (left, top, right, bottom), colour in scene:
        picture[top:bottom, left:right] = colour
    image = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    return image.contiguous(memory_format=torch.channels_last)


def seen(picture: np.ndarray, lowest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a library finds in an RGB picture: boxes, scores and classes.

    In the black border of a padded picture it finds three vehicles that are none.
    """
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert tuple(picture[0, 0]) == GROUND
    found = []
    coloured = picture[picture[:, :, 0] != picture[:, :, 2]]
    for red, green, blue in np.unique(coloured, axis=0).astype(int):
        rows, columns = np.nonzero((picture == (red, green, blue)).all(2))
        box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        found.append((*box, max(red, blue) / 255, VEHICLE if red > blue else OTHER))
    if not picture[-1, -1].any():
        high, wide = picture.shape[0] - 30, picture.shape[1] - 50
        for left, top in ((wide, 30), (50, high), (wide, high)):
            found.append((left, top, left + 40, top + 20, 0.5, VEHICLE))
    rows = np.array(found, dtype=np.float32).reshape(-1, 6)
    rows = rows[rows[:, 4] > lowest]
    return rows[:, :4], rows[:, 4], rows[:, 5].astype(int)


def bytes_of(values: torch.Tensor) -> np.ndarray:
    """The RGB picture in the values `[3, H, W]` in [0, 1] that reach a network."""
    assert values.dtype == torch.float32
    assert 0 <= values.min() <= values.max() <= 1
    exact = values * 255
    assert torch.allclose(exact, exact.round(), atol=1e-3)
    return exact.round().byte().permute(1, 2, 0).numpy()


class Masked:
    """Boxes, scores and classes of a picture, of which a mask selects some."""

    def __init__(self, **parts: Any) -> None:
        self.__dict__.update(parts)

    def __getitem__(self, mask: Any) -> Any:
        return type(self)(**{name: part[mask] for name, part in self.__dict__.items()})


def transformers() -> dict[str, Any]:
    class Processor:
        def __call__(self, images: Sequence[Any], return_tensors: str) -> dict[str, torch.Tensor]:
            assert return_tensors == "pt"
            # It takes any numbers for those of bytes, and enlarges the pictures.
            values = torch.stack([torch.as_tensor(each) for each in images])
            assert values.shape[1:] == (3, TILE, TILE)
            return {"pixel_values": torch.kron(values / 255, torch.ones(1, 1, 2, 2))}

        def post_process_object_detection(
            self, outputs: Any, threshold: float = 0.5, target_sizes: Any = None
        ) -> list[dict[str, torch.Tensor]]:
            found = []
            sizes = [(1, 1)] * len(outputs) if target_sizes is None else target_sizes
            for (boxes, scores, classes), (height, width) in zip(outputs, sizes, strict=True):
                kept = scores > threshold
                scale = torch.tensor([width, height, width, height])
                corners = torch.from_numpy(boxes) * scale
                parts = {"scores": torch.from_numpy(scores), "labels": torch.from_numpy(classes)}
                found.append({name: part[kept] for name, part in parts.items()})
                found[-1]["boxes"] = corners[kept]
            return found

    def network(pixel_values: torch.Tensor) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        side = pixel_values.shape[-1]
        every = [seen(bytes_of(each), 0) for each in pixel_values]
        return [(boxes / side, scores, classes) for boxes, scores, classes in every]

    def loads(thing: Any) -> Any:
        return SimpleNamespace(from_pretrained=lambda folder: thing)

    return {
        "transformers": SimpleNamespace(
            AutoImageProcessor=loads(Processor()), AutoModelForObjectDetection=loads(network)
        )
    }


def rfdetr(detections: Callable[..., Any] = Masked) -> dict[str, Any]:
    class RFDETRMedium:
        def __init__(self, pretrain_weights: str) -> None:
            assert pretrain_weights.endswith(".pth")

        def predict(self, images: Any, threshold: float = 0.5) -> Any:
            """Answers one image without a list, as the library does."""
            found = []
            for image in images if isinstance(images, list) else [images]:
                assert image.size == (TILE, TILE)
                boxes, scores, classes = seen(np.asarray(image), threshold)
                found.append(detections(xyxy=boxes, confidence=scores, class_id=classes))
            return found if len(found) > 1 else found[0]

    return {"rfdetr": SimpleNamespace(RFDETRMedium=RFDETRMedium)}


def sahi() -> dict[str, Any]:
    def from_pretrained(kind: str, path: str, confidence_threshold: float = 0.3) -> Any:
        assert kind == "ultralytics"
        return SimpleNamespace(lowest=confidence_threshold, image_size=None)

    def get_sliced_prediction(
        image: np.ndarray,
        model: Any,
        slice_height: int,
        slice_width: int,
        postprocess_type: str,
        verbose: int,
    ) -> Any:
        assert (slice_height, slice_width) == (SLICE, SLICE)
        # The network enlarges what is smaller than a slice as much as a slice.
        assert model.image_size * SLICE == TILE * WIDTH
        found = [
            SimpleNamespace(
                bbox=SimpleNamespace(to_xyxy=box.tolist),
                score=SimpleNamespace(value=score),
                category=SimpleNamespace(id=label, name=CLASSES[label]),
            )
            for box, score, label in zip(*seen(image, model.lowest), strict=True)
        ]
        return SimpleNamespace(object_prediction_list=found)

    return {
        "sahi": SimpleNamespace(
            AutoDetectionModel=SimpleNamespace(from_pretrained=from_pretrained)
        ),
        "sahi.predict": SimpleNamespace(get_sliced_prediction=get_sliced_prediction),
    }


def mmdet() -> dict[str, Any]:
    def init_detector(config: str, weights: str, device: str, cfg_options: Any = None) -> Any:
        return (cfg_options or {}).get("model.test_cfg.score_thr", 0.05)

    def inference_detector(lowest: float, images: Any) -> list[Any]:
        assert isinstance(images, list)
        found = []
        for image in images:
            assert image.shape[:2] == (TILE, TILE)
            parts = map(torch.from_numpy, seen(image[:, :, ::-1], lowest))
            names = ("bboxes", "scores", "labels")
            instances = Masked(**dict(zip(names, parts, strict=True)))
            found.append(SimpleNamespace(pred_instances=instances))
        return found

    apis = SimpleNamespace(init_detector=init_detector, inference_detector=inference_detector)
    return {"mmdet": SimpleNamespace(apis=apis), "mmdet.apis": apis}


def detectron2() -> dict[str, Any]:
    def get_cfg() -> Any:
        heads, retinanet = (SimpleNamespace(SCORE_THRESH_TEST=0.05) for _ in range(2))
        return SimpleNamespace(
            MODEL=SimpleNamespace(ROI_HEADS=heads, RETINANET=retinanet, DEVICE="cuda"),
            INPUT=SimpleNamespace(MIN_SIZE_TEST=800),
            merge_from_file=lambda path: None,
        )

    def predictor(settings: Any) -> Callable[[np.ndarray], Any]:
        assert settings.MODEL.DEVICE == "cpu"
        assert settings.INPUT.MIN_SIZE_TEST == 0, "vehicles are enlarged"
        lowest = settings.MODEL.ROI_HEADS.SCORE_THRESH_TEST
        assert lowest == settings.MODEL.RETINANET.SCORE_THRESH_TEST

        def predict(image: np.ndarray) -> Any:
            boxes, *others = map(torch.from_numpy, seen(image[:, :, ::-1], lowest))
            names = ("scores", "pred_classes")
            instances = SimpleNamespace(**dict(zip(names, others, strict=True)))
            instances.pred_boxes = SimpleNamespace(tensor=boxes)
            return {"instances": instances}

        return predict

    return {
        "detectron2": ModuleType("detectron2"),
        "detectron2.config": SimpleNamespace(get_cfg=get_cfg),
        "detectron2.engine": SimpleNamespace(DefaultPredictor=predictor),
    }


def libreyolo() -> dict[str, Any]:
    def load(path: str, device: str) -> Any:
        def network(images: Any, conf: float = 0.25) -> list[Any]:
            assert isinstance(images, list)
            found = []
            for image in images:
                # Like OpenCV it takes arrays for BGR.
                picture = np.asarray(image)
                rgb = picture if isinstance(image, Image.Image) else picture[:, :, ::-1]
                assert rgb.shape[:2] == (TILE, TILE)
                parts = map(torch.from_numpy, seen(rgb, conf))
                boxes = Masked(**dict(zip(("xyxy", "conf", "cls"), parts, strict=True)))
                boxes.cls = boxes.cls.float()
                found.append(SimpleNamespace(boxes=boxes, names=CLASSES))
            return found

        return network

    return {"libreyolo": SimpleNamespace(LibreYOLO=load)}


STAND_INS: dict[str, Callable[[], dict[str, Any]]] = {
    "hugging_face": transformers,
    "supervision_detections": rfdetr,
    "sahi_slices": sahi,
    "mmdetection": mmdet,
    "detectron2_predictor": detectron2,
    "libreyolo_detector": libreyolo,
}


def assessed(text: str, modules: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
    """The callable and the keywords that a recipe gives to `sp.assess`."""
    given: list[inspect.BoundArguments] = []
    signature = inspect.signature(sp.assess)
    with pytest.MonkeyPatch.context() as patch:
        for name, module in (modules or {}).items():
            patch.setitem(sys.modules, name, module)
        patch.setattr(
            sp, "assess", lambda *each, **named: given.append(signature.bind(*each, **named))
        )
        exec(compile(text, "recipe", "exec"), {"__name__": "__main__"})
    (call,) = given
    return call.arguments["detector"], call.arguments


def compare(ask: Any, arguments: dict[str, Any], scenes: Sequence[Any], *size: int) -> None:
    """Compares the detections of a recipe's callable with the rectangles in its images."""
    assert {"imagery", "labels", "vehicle_classes"} <= set(arguments)
    detector = BlackBoxDetector(ask, vehicle_classes=arguments["vehicle_classes"])
    others = detector.of_other_classes()
    assert others is not None
    images = torch.cat([drawn(scene, *size) for scene in scenes])
    # Vehicles are red, and others blue.
    for asked, channel in ((detector, 0), (others, 2)):
        for found, scene in zip(asked.detect(images), scenes, strict=True):
            meant = [(box, colour[channel]) for box, colour in scene if colour[channel]]
            boxes = torch.tensor([box for box, _ in meant]).float().reshape(-1, 4)
            assert found.boxes.shape == boxes.shape
            torch.testing.assert_close(found.boxes, boxes, rtol=0, atol=0.01)
            scores = torch.tensor([value / 255 for _, value in meant])
            torch.testing.assert_close(found.scores, scores, rtol=0, atol=1e-5)


def check(text: str, modules: dict[str, Any]) -> None:
    """Compares the detections of a recipe that asks a stand-in with the rectangles."""
    compare(*assessed(text, modules), SCENES)


def test_every_recipe_has_a_stand_in():
    assert sorted(STAND_INS) == NAMES


@pytest.mark.parametrize("recipe", RECIPES, ids=NAMES)
def test_a_recipe_gives_the_boxes_of_its_library(recipe: Path):
    check(code(recipe), STAND_INS[recipe.stem]())


@pytest.mark.parametrize("recipe", RECIPES, ids=NAMES)
def test_a_recipe_is_short_and_stands_in_the_docs(recipe: Path):
    lines = [line for line in code(recipe).splitlines() if line.strip()]
    assert len(lines) <= LONGEST
    # A recipe of a library's name would import itself.
    assert recipe.stem not in STAND_INS[recipe.stem]()
    page = (ROOT / "docs" / "detectors.md").read_text(encoding="utf-8")
    assert f"(../examples/recipes/{recipe.name})" in page


def test_refusals_of_checkpoints_name_recipes_that_exist(tmp_path: Path):
    (tmp_path / "vehicles.onnx").write_bytes(b"other bytes")
    with pytest.raises(StoredFileError) as refused:
        read_checkpoint(tmp_path / "vehicles.onnx")
    named = re.findall(r"examples/[\w/.]*\w", str(refused.value))
    assert named == ["examples/recipes"]
    assert "it is an ONNX file, which skyproof assess takes as it is" in str(refused.value)
    network = tmp_path / "vehicles.pt"
    torch.save({"weight": torch.zeros(2)}, network)
    with pytest.raises(StoredFileError, match=r" to ONNX.* a function .*\(examples/recipes\)\.$"):
        read_ultralytics(Checkpoint(network, "ultralytics", ["car"]), {}, {}, "")
    assert all((ROOT / place).exists() for place in named)


# The right words, and mistakes of a user.
SWAPPED = ("(images * 255)", "(images.flip(1) * 255)")
MISTAKES = {
    "hugging_face": [
        ("padded * 255", "padded.flip(1) * 255"),
        ("(padded * 255).round().byte()", "padded"),
        ("[(side, side)] * len(images)", "[(1, 1)] * len(images)"),
        ("[(side, side)] * len(images)", "[(height, width)] * len(images)"),
        ("outputs, 0.01, ", "outputs, target_sizes="),
        ("[width, height]", "[side, side]"),
        ("max(TILE, height, width)", "max(height, width)"),
    ],
    "supervision_detections": [
        SWAPPED,
        (", threshold=0.01", ""),
        (".crop(area)", ""),
        ("(width, height)", "(TILE, TILE)"),
        ("each.xyxy[:, :2]", "each.xyxy[:, 2:]"),
        ('"boxes": one.xyxy', '"boxes": one.xyxy / 2'),
    ],
    "sahi_slices": [
        SWAPPED,
        (", confidence_threshold=0.01", ""),
        ("SIDE * min(SLICE, max(picture.shape)) // SLICE", "SIDE"),
        ("each.bbox.to_xyxy()", "[*each.bbox.to_xyxy()[:2], 40, 20]"),
        ("each.category.name", "each.category.id"),
    ],
    "mmdetection": [
        (".flip(1)", ""),
        (", cfg_options=LOW", ""),
        ("model.test_cfg.score_thr", "model.test_cfg.score"),
        ("TILE - width", "-width"),
        ("[width, height]", "[TILE, TILE]"),
        ('"boxes": one.bboxes', '"boxes": one.bboxes / TILE'),
    ],
    "detectron2_predictor": [
        ("[:, :, ::-1]", ""),
        ("settings.MODEL.RETINANET.SCORE_THRESH_TEST = 0.01", "0.3"),
        ("settings.INPUT.MIN_SIZE_TEST = WEIGHTS, ", "settings.other = WEIGHTS, "),
        (".byte()", ""),
        ("found.pred_boxes.tensor", "found.pred_boxes.tensor[:, [0, 1, 3, 2]]"),
    ],
    "libreyolo_detector": [
        SWAPPED,
        ("Image.fromarray(each).crop(area)", "each"),
        (", conf=0.01", ""),
        ("[width, height]", "[TILE, TILE]"),
        ('"labels": one.cls', '"labels": one.conf'),
    ],
}


@pytest.mark.parametrize(
    ("name", "right", "wrong"), [(name, *each) for name in NAMES for each in MISTAKES[name]]
)
def test_a_mistake_in_a_recipe_is_noticed(name: str, right: str, wrong: str):
    text = code(ROOT / "examples" / "recipes" / f"{name}.py")
    assert right in text
    with pytest.raises((AssertionError, DetectorAnswerError)):
        check(text.replace(right, wrong), STAND_INS[name]())


def test_transformers_gives_the_boxes_of_its_own_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    transformers = pytest.importorskip("transformers", reason="needs transformers")
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    backbone = transformers.RTDetrResNetConfig(
        embedding_size=8,
        hidden_sizes=[8, 16, 16, 16],
        depths=[1, 1, 1, 1],
        layer_type="basic",
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.RTDetrConfig(
        backbone_config=backbone,
        encoder_hidden_dim=16,
        encoder_in_channels=[16, 16, 16],
        encoder_ffn_dim=16,
        encoder_attention_heads=2,
        d_model=16,
        decoder_in_channels=[16, 16, 16],
        decoder_ffn_dim=16,
        decoder_attention_heads=2,
        decoder_layers=1,
        num_queries=30,
    )
    transformers.AutoModelForObjectDetection.from_config(config).save_pretrained("vehicles")
    transformers.RTDetrImageProcessor().save_pretrained("vehicles")
    text = code(ROOT / "examples" / "recipes" / "hugging_face.py").replace(f" {TILE}", " 160")
    ask, _ = assessed(text)
    image = drawn(SCENES[0])
    with torch.no_grad():
        (found,) = ask(image)
    picture = Image.fromarray((image[0] * 255).byte().permute(1, 2, 0).numpy())
    pipeline = transformers.pipeline("object-detection", model="vehicles")
    # It rounds boxes down to whole pixels.
    sides = ("xmin", "ymin", "xmax", "ymax")
    theirs = [
        (each["score"], *map(each["box"].get, sides))
        for each in pipeline(picture.crop((0, 0, 160, 160)), threshold=0.01)
        if each["box"]["xmin"] < WIDTH and each["box"]["ymin"] < HEIGHT
    ]
    ours = torch.cat([found["scores"][:, None], found["boxes"]], dim=1)
    assert len(ours) > 5
    ours, expected = (torch.tensor(sorted(each)) for each in (ours.tolist(), theirs))
    torch.testing.assert_close(ours[:, 0], expected[:, 0], rtol=0, atol=1e-5)
    assert ((ours[:, 1:] - expected[:, 1:] > -0.01) & (ours[:, 1:] - expected[:, 1:] < 1.01)).all()


def test_sahi_searches_slice_by_slice():
    library = pytest.importorskip("sahi", reason="needs sahi")
    from sahi.models.base import DetectionModel
    from sahi.prediction import ObjectPrediction
    from sahi.utils.compatibility import fix_full_shape_list, fix_shift_amount_list

    class Finder(DetectionModel):
        def load_model(self) -> None:
            self.sizes: set[tuple[int, ...]] = set()

        def perform_inference(self, image: np.ndarray) -> None:
            self.sizes.add(image.shape[:2])
            self._original_predictions = seen(image, self.confidence_threshold)

        def _create_object_prediction_list_from_original_predictions(
            self, shift_amount_list: Any = None, full_shape_list: Any = None
        ) -> None:
            self._object_prediction_list_per_image = [
                [
                    ObjectPrediction(
                        bbox=box.tolist(),
                        category_id=int(label),
                        category_name=CLASSES[label],
                        score=float(score),
                        shift_amount=fix_shift_amount_list(shift_amount_list)[0],
                        full_shape=fix_full_shape_list(full_shape_list)[0],
                    )
                    for box, score, label in zip(*self._original_predictions, strict=True)
                ]
            ]

    models = []

    def from_pretrained(*given: Any, **named: Any) -> Any:
        inspect.signature(original).bind(*given, **named)
        models.append(Finder(confidence_threshold=named["confidence_threshold"], device="cpu"))
        return models[0]

    original = library.AutoDetectionModel.from_pretrained
    # The second vehicle lies in every slice.
    scene = [
        ((20, 20, 60, 40), (230, 0, 0)),
        ((160, 100, 180, 120), (200, 0, 0)),
        ((300, 200, 340, 230), (180, 0, 0)),
        ((30, 260, 50, 280), (0, 0, 170)),
        ((300, 20, 320, 40), (10, 0, 0)),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library.AutoDetectionModel, "from_pretrained", from_pretrained)
        ask, arguments = assessed(code(ROOT / "examples" / "recipes" / "sahi_slices.py"))
    compare(ask, arguments, [scene], 300, 400)
    assert models[0].sizes == {(SLICE, SLICE), (300, 400)}
    assert models[0].image_size == TILE


def test_supervision_answers_with_its_detections():
    supervision = pytest.importorskip("supervision", reason="needs supervision")
    recipe = ROOT / "examples" / "recipes" / "supervision_detections.py"
    check(code(recipe), rfdetr(supervision.Detections))
