"""ONNX files are asked as their library asks them, and run nothing but standard operators."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from detector_images import needs_yolo

from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.onnx_file import OnnxFile
from skyproof.detectors.ultralytics_detectors import _quiet_import
from skyproof.errors import ConfigurationError, DetectorAnswerError, StoredFileError

onnx = pytest.importorskip("onnx", reason="needs onnx (pip install 'skyproof[onnx]')")
pytest.importorskip("onnxruntime", reason="needs onnxruntime (pip install 'skyproof[onnx]')")

GSD_M = 0.125
SIDE, CELL = 96, 8
CELLS = SIDE // CELL
NAMES = {"names": "{0: 'car', 1: 'van', 2: 'shed'}"}
CLASSES = ["car", "van"]
EMPTY = torch.zeros(1, 3, SIDE, SIDE)


def written(path: Path, model: Any, told: dict[str, str]) -> Path:
    for key, value in told.items():
        model.metadata_props.add(key=key, value=value)
    path.write_bytes(model.SerializeToString())
    return path


def model_of(
    nodes: list[Any], outputs: list[str], shape: list[Any] | None = None, **given: Any
) -> Any:
    """A model of nodes, whose inputs are images of a shape."""
    kind = given.pop("kind", onnx.TensorProto.FLOAT)
    images = onnx.helper.make_tensor_value_info("images", kind, shape or [1, 3, SIDE, SIDE])
    found = [onnx.helper.make_empty_tensor_value_info(name) for name in outputs]
    graph = onnx.helper.make_graph(nodes, "detector", [images], found, **given)
    opsets = [onnx.helper.make_opsetid("", 17), onnx.helper.make_opsetid("theirs", 1)]
    return onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8)


def constant(name: str, values: Any) -> Any:
    array = np.asarray(values)
    array = array.astype(np.float32) if array.dtype == np.float64 else array
    tensor = onnx.numpy_helper.from_array(array)
    return onnx.helper.make_node("Constant", [], [name], value=tensor)


def answering(path: Path, told: dict[str, str], shape: Any = None, **outputs: Any) -> Path:
    """A file whose network gives the same outputs for every image."""
    nodes = [constant(name, values) for name, values in outputs.items()]
    return written(path, model_of(nodes, [*outputs], shape), told)


def opened(path: Path, classes: list[str] | None = None, gsd_m: float | None = None) -> Any:
    file = OnnxFile(path, CLASSES if classes is None else classes, gsd_m, GSD_M)
    return BlackBoxDetector(file, "mine", vehicle_classes=CLASSES if classes is None else classes)


def rows_of(answer: dict[str, Any]) -> list[tuple[list[int], float, str]]:
    """The answer to an image, by falling score."""
    parts = zip(answer["boxes"], answer["scores"], answer["labels"], strict=True)
    rows = [([*map(round, box.tolist())], round(float(s), 3), label) for box, s, label in parts]
    return sorted(rows, key=lambda row: -row[1])


# Middle, size and scores of three classes. The last one finds nothing.
FOUND = [
    ((30, 20, 20, 10), (0.9, 0.02, 0.001)),
    ((70, 60, 10, 24), (0.003, 0.7, 0.002)),
    ((50, 90, 8, 4), (0.004, 0.0, 0.009)),
]
WANTED = [
    ([20, 15, 40, 25], 0.9, "car"),
    ([65, 48, 75, 72], 0.7, "van"),
    ([20, 15, 40, 25], 0.02, "van"),
]
TURNED = [([24, 16, 36, 24], 0.9, "car"), ([40, 38, 60, 62], 0.7, "van")]
MIDDLES = np.array([middle for middle, _ in FOUND], dtype=np.float32)
SCORES = np.array([scores for _, scores in FOUND], dtype=np.float32)
CORNERS = np.hstack([MIDDLES[:, :2] - MIDDLES[:, 2:] / 2, MIDDLES[:, :2] + MIDDLES[:, 2:] / 2])
LOGITS = np.log(np.clip(SCORES, 1e-6, 1) / (1 - SCORES))
# Softmax over three classes and no object gives these scores.
ALONE = np.log(np.hstack([np.clip(SCORES, 1e-6, 1), 1 - SCORES.sum(1, keepdims=True)]))
PADDING = np.tile([40.0, 40, 5, 5, 0, 0, 0], (20, 1))
COLUMNS = np.vstack([np.hstack([MIDDLES, SCORES]), PADDING])
ENDS = np.hstack([CORNERS[:2], [[0.9, 0], [0.7, 1]]])
# A turn by 90 degrees exchanges the sides; by 45 they grow.
ANGLES = [(30, 20, 8, 12, 0.9, 0, np.pi / 2), (50, 50, 12 * 2**0.5 - 2, 12 * 2**0.5 - 2, 0.7, 1, 0)]


def layouts() -> dict[str, tuple[dict[str, str], dict[str, Any]]]:
    """Metadata and outputs of every layout."""
    objectness = np.hstack([MIDDLES, np.full((3, 1), 0.5), SCORES * 2 * 0.999])
    anchors = np.tile([40.0, 40, 5, 5, 0, 0, 0, 0], (300, 1))
    two = np.array(ANGLES)
    two[1, 2:4] = (20, 24)
    turned = np.hstack([two[:, :4], [[0.9, 0.0, 0], [0, 0.7, 0]], two[:, 6:]])
    deepness = {"class_names": '{"0": "car", "1": "van", "2": "shed"}'}
    task = {**NAMES, "task": "obb"}
    ends = {**NAMES, "end2end": "True"}
    boxes = MIDDLES / SIDE
    labels = np.array([0, 1], dtype=np.int64)
    return {
        "ultralytics": (NAMES, {"output0": COLUMNS.T[None]}),
        "deepness": (deepness, {"output": COLUMNS.T[None].astype(np.float16)}),
        "yolov5": (NAMES, {"output": np.vstack([objectness, anchors])[None]}),
        "ends": (
            ends,
            {"output0": np.vstack([ENDS, np.tile([5.0, 5, 50, 50, 0.005, 0], (298, 1))])[None]},
        ),
        "turned": (task, {"output0": np.vstack([turned, np.zeros((20, 8))]).T[None]}),
        "turned_ends": (task, {"output0": np.vstack([two, np.zeros((8, 7))])[None]}),
        "rtdetr": (
            {**NAMES, "head": "RTDETRDecoder"},
            {"output0": np.hstack([boxes[:2], ENDS[:, 4:]])[None]},
        ),
        "detr": (NAMES, {"logits": LOGITS[None], "pred_boxes": boxes[None]}),
        "detr_softmax": (NAMES, {"pred_boxes": boxes[None], "logits": ALONE[None]}),
        "torchvision": (
            NAMES,
            {"boxes": CORNERS[:2], "labels": labels, "scores": np.array([0.9, 0.7])},
        ),
        "torchvision_batch": (
            NAMES,
            {"s": np.array([[0.9, 0.7]]), "b": CORNERS[None, :2], "labels": labels[None]},
        ),
    }


@pytest.mark.parametrize("layout", [*layouts()])
def test_every_layout_gives_the_same_boxes(layout: str, tmp_path: Path) -> None:
    told, outputs = layouts()[layout]
    detector = opened(answering(tmp_path / "x.onnx", told, **outputs))
    wanted = WANTED
    if layout in ("turned", "turned_ends"):
        wanted = TURNED
    elif layout in ("ends", "rtdetr", "torchvision", "torchvision_batch"):
        wanted = WANTED[:2]
    (answer,) = detector._detect(EMPTY)
    found = rows_of(answer)
    assert [each[::2] for each in found] == [each[::2] for each in wanted]
    assert [each[1] for each in found] == pytest.approx([each[1] for each in wanted], abs=2e-3)
    # The best vehicle class counts once.
    (vehicles,) = detector.detect(EMPTY)
    assert vehicles.boxes.round().int().tolist() == [box for box, _, _ in wanted[:2]]


@pytest.mark.parametrize(
    ("told", "rows", "box", "label"),
    [
        ({"names": "{0: 'car'}"}, 567, [0, 0, 30, 45], "car"),
        ({}, 567, [0, 0, 30, 45], "0"),
        ({"end2end": "True"}, 567, [10, 20, 40, 50], "1"),
        ({}, 300, [10, 20, 40, 50], "1"),
    ],
)
def test_six_columns_are_of_yolov5_if_it_has_three_anchors_in_each_cell(
    told: dict[str, str], rows: int, box: list[int], label: str, tmp_path: Path
) -> None:
    table = np.zeros((1, rows, 6))
    table[0, 3] = (10, 20, 40, 50, 0.9, 1)
    file = OnnxFile(answering(tmp_path / "x.onnx", told, output=table), [], None, GSD_M)
    assert rows_of(file.detect(EMPTY)[0]) == [(box, 0.9, label)]


def test_a_vehicle_of_several_classes_is_one_and_other_classes_are_told(tmp_path: Path) -> None:
    told, outputs = layouts()["ultralytics"]
    detector = opened(answering(tmp_path / "x.onnx", told, **outputs), ["van"])
    (vans,) = detector.detect(EMPTY)
    assert vans.scores.tolist() == pytest.approx([0.7, 0.02])
    others = detector.of_other_classes()
    assert others is not None
    (cars,) = others.detect(EMPTY)
    assert cars.scores.tolist() == pytest.approx([0.9])


@pytest.mark.parametrize(("told", "count"), [({}, 2), ({"det_iou_thresh": "0.4"}, 1)])
def test_boxes_are_suppressed_class_by_class(
    told: dict[str, str], count: int, tmp_path: Path
) -> None:
    # The overlap of neighbours is 0.6; one pair is of two classes.
    rows = [[30, 20, 20, 10, 0.9, 0], [35, 20, 20, 10, 0.8, 0], [32, 20, 20, 10, 0, 0.7]]
    table = np.array(rows + [[50, 50, 9, 9, 0, 0]] * 9, dtype=np.float32)
    path = answering(tmp_path / "x.onnx", {**told, "names": "['car', 'van']"}, y=table.T[None])
    (answer,) = OnnxFile(path, ["car"], None, GSD_M).detect(EMPTY)
    assert answer["labels"] == ["car"] * count + ["van"]


def in_cells(path: Path, told: dict[str, str], kind: str = "FLOAT", rank: int = 4) -> Path:
    """A file whose network finds the red of cells of 8 px, in boxes of 12 x 6 px."""
    number = getattr(onnx.TensorProto, kind)
    columns, rows = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    middles = [(columns + 0.5) * CELL, (rows + 0.5) * CELL, 12 + 0 * rows, 6 + 0 * rows]
    boxes = np.stack(middles).reshape(1, 4, -1).astype(np.float32)
    make = onnx.helper.make_node
    batched = [constant("shape", [1, 3, SIDE, SIDE]), make("Reshape", ["images", "shape"], ["b"])]
    nodes = [
        *batched,
        *(constant(name, [value]) for name, value in (("from", 0), ("to", 1), ("axis", 1))),
        make("Slice", ["b", "from", "to", "axis"], ["red"]),
        make("Cast", ["red"], ["plain"], to=onnx.TensorProto.FLOAT),
        make("MaxPool", ["plain"], ["cells"], kernel_shape=[CELL, CELL], strides=[CELL, CELL]),
        constant("flat", [1, 1, -1]),
        make("Reshape", ["cells", "flat"], ["scores"]),
        constant("boxes", boxes),
        make("Concat", ["boxes", "scores"], ["output0"], axis=1),
    ]
    shape = [1, 3, SIDE, SIDE][-rank:]
    return written(path, model_of(nodes, ["output0"], shape, kind=number), told)


def shown(height: int, width: int, middles: list[tuple[int, int]], size: int = 4) -> torch.Tensor:
    """An image that is red around some places."""
    image = torch.zeros(1, 3, height, width)
    for x, y in middles:
        image[:, 0, y - size // 2 : y + size // 2, x - size // 2 : x + size // 2] = 0.9
    return image


@pytest.mark.parametrize(("kind", "rank"), [("FLOAT", 4), ("FLOAT16", 4), ("FLOAT", 3)])
def test_smaller_images_are_padded_with_grey(kind: str, rank: int, tmp_path: Path) -> None:
    file = OnnxFile(in_cells(tmp_path / "x.onnx", {}, kind, rank), ["0"], None, GSD_M)
    assert file.window_px == 192
    answers = file.detect(torch.cat([shown(64, 80, [(20, 12)]), shown(64, 80, [(60, 36)])]))
    red = [[row for row in rows_of(each) if row[1] == 0.9] for each in answers]
    assert red == [[([14, 9, 26, 15], 0.9, "0")], [([54, 33, 66, 39], 0.9, "0")]]
    # The padding has a score of its own; what lies in it is left out, and cut at the border.
    for answer in answers:
        grey = answer["boxes"][(answer["scores"] - 114 / 255).abs() < 1e-3]
        assert grey[:, 2].max() <= 80
        assert grey[:, 3].max() <= 64
        assert len(grey) < 30


def test_larger_images_are_seen_in_windows(tmp_path: Path) -> None:
    file = OnnxFile(in_cells(tmp_path / "x.onnx", {}), ["0"], None, GSD_M)
    places = [(10, 10), (100, 30), (150, 140), (250, 100), (290, 190), (76, 76)]
    (answer,) = file.detect(shown(200, 300, places))
    found = answer["boxes"][answer["scores"] > 0.8]
    middles = (found[:, :2] + found[:, 2:]) / 2
    # A red spot lies in up to four cells.
    near = torch.cdist(middles, torch.tensor(places).float())
    assert near.min(0).values.max() < 12
    assert near.min(1).values.max() < 12
    # Four windows overlap here, and one has the middle in its core.
    (answer,) = file.detect(shown(160, 160, [(68, 68)]))
    assert answer["boxes"][answer["scores"] > 0.8].tolist() == [[62, 65, 74, 71]]


@pytest.mark.parametrize(
    ("told", "gsd_m", "image_px"),
    [({}, None, 96), ({"resolution": "25.0"}, None, 192), ({"resolution": "25"}, 0.0625, 48)],
)
def test_images_are_scaled_to_the_detectors_resolution(
    told: dict[str, str], gsd_m: float | None, image_px: int, tmp_path: Path
) -> None:
    file = OnnxFile(in_cells(tmp_path / "x.onnx", told), ["0"], gsd_m, GSD_M)
    ratio = image_px / SIDE
    spot = [(round(28 * ratio), round(52 * ratio))]
    (answer,) = file.detect(shown(image_px, image_px, spot, size=round(8 * ratio)))
    best = answer["boxes"][answer["scores"].argmax()]
    wanted = torch.tensor([22, 49, 34, 55]) * ratio
    torch.testing.assert_close(best, wanted, rtol=0, atol=0.01)


def test_a_network_of_any_size_sees_multiples_of_its_stride(tmp_path: Path) -> None:
    make = onnx.helper.make_node
    nodes = [
        make("Shape", ["images"], ["sizes"]),
        *(constant(name, [value]) for name, value in (("from", 2), ("to", 4))),
        make("Slice", ["sizes", "from", "to"], ["px"]),
        make("Cast", ["px"], ["sides"], to=onnx.TensorProto.FLOAT),
        constant("part", [0.5, 0.5]),
        make("Mul", ["sides", "part"], ["lower"]),
        constant("upper", [0.0, 0.0]),
        constant("rest", [0.9, 0.0]),
        make("Concat", ["upper", "lower", "rest"], ["row"], axis=0),
        constant("shape", [1, 1, 6]),
        make("Reshape", ["row", "shape"], ["output0"]),
    ]
    told = {"stride": "64", "imgsz": "[256, 256]", "end2end": "True"}
    model = model_of(nodes, ["output0"], ["batch", 3, "height", "width"])
    file = OnnxFile(written(tmp_path / "x.onnx", model, told), ["0"], None, GSD_M)
    assert file.window_px == 256
    (answer,) = file.detect(torch.zeros(1, 3, 130, 130))
    assert answer["boxes"].tolist() == [[0, 0, 96, 96]]


def body(*nodes: Any) -> Any:
    condition = onnx.helper.make_tensor_value_info("kept", onnx.TensorProto.BOOL, [])
    return onnx.helper.make_graph([constant("kept", True), *nodes], "body", [], [condition])


def custom(name: str = "hidden") -> Any:
    return onnx.helper.make_node("Execute", [], [name], domain="theirs")


def outside() -> Any:
    tensor = onnx.numpy_helper.from_array(np.zeros(4, dtype=np.float32), "weights")
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")
    return tensor


def forbidden() -> dict[str, tuple[Any, str]]:
    found = constant("output0", ENDS[None].astype(np.float32))
    make = onnx.helper.make_node
    branches = {"then_branch": body(custom()), "else_branch": body()}
    conditions = [constant("yes", True), make("If", ["yes"], ["then"], **branches)]
    opsets = [onnx.helper.make_opsetid("theirs", 1)]
    function = onnx.helper.make_function("ai.onnx", "Own", [], ["o"], [custom("o")], opsets)
    inside = model_of([found], ["output0"])
    inside.functions.append(function)
    with_tensor = make("Constant", [], ["own"], value=outside())
    return {
        "operator": (model_of([found, custom()], ["output0"]), "Execute of theirs"),
        "branch": (model_of([found, *conditions], ["output0"]), "Execute of theirs"),
        "function": (inside, "Execute of theirs"),
        "weights": (model_of([found], ["output0"], initializer=[outside()]), "another file"),
        "constant": (model_of([found, with_tensor], ["output0"]), "another file"),
        "unknown": (model_of([found, make("NoSuch", [], ["a"])], ["output0"]), "NoSuch"),
    }


@pytest.mark.parametrize("case", [*forbidden()])
def test_a_file_that_asks_for_more_than_the_standard_is_refused(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, words = forbidden()[case]
    path = written(tmp_path / "x.onnx", model, {})
    if case != "unknown":
        # It is refused before the runtime sees it.
        monkeypatch.setattr("onnxruntime.InferenceSession", None)
    with pytest.raises(StoredFileError, match=rf"x\.onnx is no detector .*{words}.*; export one"):
        OnnxFile(path, ["0"], None, GSD_M)


def test_the_runtime_computes_on_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    given = []
    session = onnxruntime.InferenceSession
    monkeypatch.setattr(
        onnxruntime, "InferenceSession", lambda *each: given.append(each[2]) or session(*each)
    )
    OnnxFile(answering(tmp_path / "x.onnx", NAMES, **ONE), CLASSES, None, GSD_M)
    assert given == [["CPUExecutionProvider"]]


def test_the_runtime_reads_nothing_but_the_checked_form(tmp_path: Path) -> None:
    model = model_of([constant("output0", ENDS[None].astype(np.float32))], ["output0"])
    # As the fifth to eighth byte, they mark a file of the runtime's own format.
    model.producer_name = "ORTM"
    path = written(tmp_path / "x.onnx", model, {})
    assert path.read_bytes()[4:8] == b"ORTM"
    assert OnnxFile(path, ["0"], None, GSD_M).detect(EMPTY)[0]["labels"] == ["0", "1"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "no detector"), (b"just a text\n" * 9, "no detector"), (b"\x08\x08", "no detector")],
)
def test_what_is_no_onnx_file_is_one_sentence(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    path.write_bytes(content)
    with pytest.raises(StoredFileError, match=words) as refused:
        OnnxFile(path, ["0"], None, GSD_M)
    assert "\n" not in str(refused.value)
    assert ": ;" not in str(refused.value)


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    with path.open("wb") as file:
        file.truncate(2**31 + 1)
    with pytest.raises(StoredFileError, match="2 GB or more"):
        OnnxFile(path, ["0"], None, GSD_M)


TWO = {"first": COLUMNS.T[None], "second": COLUMNS.T[None]}
ONE = {"output0": COLUMNS.T[None]}


@pytest.mark.parametrize(
    ("told", "outputs", "words"),
    [
        (
            NAMES,
            TWO,
            r"2 outputs, not one, fit its 3 class names: first \[1, 7, 23\]",
        ),
        (
            {"names": "['car']"},
            ONE,
            r"0 outputs, not one, fit its 1 class names: output0 \[1, 7, 23\]",
        ),
        (NAMES, {"y": np.zeros((1, 8, 4, 4))}, r"0 outputs, not one, .*: y \[1, 8, 4, 4\]"),
        ({"names": "__import__('os').getcwd()"}, ONE, "names of classes are __import__"),
        ({"names": "[" * 5000}, ONE, "names of classes are"),
        ({"names": f"{{0: '{'a' * 100_000}'}}"}, ONE, "names of classes are {0: 'aaa"),
        ({**NAMES, "det_iou_thresh": "high"}, ONE, "'high'"),
        ({**NAMES, "resolution": "9000"}, ONE, "90 m per pixel is out of reason"),
        ({**NAMES, "resolution": "nan"}, ONE, "nan m per pixel is out of reason"),
    ],
)
def test_what_cannot_be_told_is_refused(
    told: dict[str, str], outputs: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(StoredFileError, match=words):
        opened(answering(tmp_path / "x.onnx", told, **outputs))


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ([1, SIDE, SIDE, 3], "UINT8"),
        ([1, 3, SIDE, SIDE], "UINT8"),
        ([4, 3, SIDE, SIDE], "FLOAT"),
        ([1, 4, SIDE, SIDE], "FLOAT"),
        ([1, 3, 8, 8], "FLOAT"),
        ([1, 3], "FLOAT"),
    ],
)
def test_other_inputs_are_refused(shape: list[int], kind: str, tmp_path: Path) -> None:
    nodes = [constant("output0", ENDS[None].astype(np.float32))]
    model = model_of(nodes, ["output0"], shape, kind=getattr(onnx.TensorProto, kind))
    came = rf"it takes tensor\({kind.lower()}\) \[{', '.join(map(str, shape))}\]"
    with pytest.raises(StoredFileError, match=came):
        OnnxFile(written(tmp_path / "x.onnx", model, {}), ["0"], None, GSD_M)


@pytest.mark.parametrize(
    ("told", "classes", "words"),
    [
        (NAMES, ["car", "boat"], "expects some of car, van, shed; got boat"),
        (NAMES, ["0"], "expects some of car, van, shed; got 0"),
        ({}, ["car"], "expects some of 0, 1, 2; got car"),
        ({}, ["0", "3"], "expects some of 0, 1, 2; got 3"),
    ],
)
def test_unknown_classes_are_refused_with_the_known_ones(
    told: dict[str, str], classes: list[str], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=f"--vehicle-classes {words}"):
        opened(answering(tmp_path / "x.onnx", told, **ONE), classes)


def test_without_the_runtime_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = answering(tmp_path / "x.onnx", NAMES, **ONE)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'skyproof\[onnx\]'"):
        opened(path)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ([10, 10, 20, 20, np.nan, 0], "NaN or infinity"),
        ([10, np.inf, 20, 20, 0.5, 0], "NaN or infinity"),
        ([10, 10, 20, 20, 0.5, 0.25], "broken numbers of classes"),
    ],
)
def test_answers_that_cannot_be_are_refused(row: list[float], words: str, tmp_path: Path) -> None:
    path = answering(tmp_path / "x.onnx", {"end2end": "True"}, output0=np.array([[row]]))
    with pytest.raises(DetectorAnswerError, match=words):
        opened(path, ["0"]).detect(EMPTY)


def test_scores_without_sigmoid_are_refused(tmp_path: Path) -> None:
    rows = np.array([[30, 20, 20, 10, 4.5]] + [[50, 50, 9, 9, -3]] * 9)
    path = answering(tmp_path / "x.onnx", {}, output0=rows.T[None])
    with pytest.raises(DetectorAnswerError, match=r"scores lie in \[0, 1\], got 4.5"):
        opened(path, ["0"]).detect(EMPTY)


def exported(folder: Path, file: str, **settings: Any) -> tuple[Any, Path]:
    """A network that Ultralytics builds from a YAML file, with one class, and its export."""
    from ultralytics import YOLO
    from ultralytics.nn.tasks import yaml_model_load
    from ultralytics.utils import YAML

    torch.manual_seed(0)
    YAML.save(folder / file, {**yaml_model_load(file), "nc": 1})
    yolo = YOLO(folder / file)
    yolo.model.names = {0: "car"}
    # Fresh networks find the same everywhere.
    for module in yolo.model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = 1.0
    with torch.no_grad():
        yolo.model.train()(torch.rand(2, 3, 160, 160))
        for name, parameter in yolo.model.named_parameters():
            if re.search(r"cv[234]\.\d\.2\.", name):
                parameter.copy_(0.01 * torch.randn(parameter.shape))
                # Sides above zero.
                parameter.add_(3.0 * (name.endswith("bias") and "cv2" in name))
    yolo.model.eval()
    # It stores halves.
    yolo.save(str(folder / "network.pt"))
    stored = YOLO(folder / "network.pt")
    made = stored.export(format="onnx", imgsz=160, simplify=False, verbose=False, **settings)
    task = {"obb": "obb", "seg": "segment"}.get(file[-8:-5], "detect")
    return YOLO(made, task=task), Path(made)


@needs_yolo
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("file", "settings"),
    [
        ("yolov8n.yaml", {}),
        pytest.param("yolo11n.yaml", {"dynamic": True}, marks=pytest.mark.slow),
        pytest.param("yolo26n.yaml", {"nms": False}, marks=pytest.mark.slow),
        pytest.param("yolov8n-obb.yaml", {}, marks=pytest.mark.slow),
        pytest.param("yolo11n-seg.yaml", {}, marks=pytest.mark.slow),
        pytest.param("yolo26n-seg.yaml", {}, marks=pytest.mark.slow),
        ("yolo26n-obb.yaml", {"nms": False}),
    ],
)
def test_an_export_of_ultralytics_finds_what_ultralytics_finds(
    file: str, settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = torch.rand(1, 3, 160, 160, generator=torch.Generator().manual_seed(1))
    with _quiet_import():
        monkeypatch.setenv("YOLO_AUTOINSTALL", "false")
        # An export is named after the YAML file, in the working directory.
        monkeypatch.chdir(tmp_path)
        theirs, path = exported(tmp_path, file, **settings)
        # Turned boxes are suppressed by another overlap.
        iou = 1.0 if "obb" in file else 0.7
        (found,) = theirs.predict(image, conf=0.0101, iou=iou, max_det=3000, imgsz=160)
    rows = found.boxes if found.obb is None else found.obb
    boxes, scores = rows.xyxy.clamp(0, 160), rows.conf
    inside = (boxes[:, 2:] - boxes[:, :2] > 0.5).all(1)
    boxes, scores = boxes[inside], scores[inside]
    (answer,) = OnnxFile(path, ["car"], None, GSD_M).detect(image)
    assert set(answer["labels"]) == {"car"}
    ours = answer["scores"] > 0.0101
    away = (answer["boxes"][ours, None] - boxes).abs().amax(-1)
    other = (answer["scores"][ours, None] - scores).abs()
    same = (away < 0.5) & (other < 1e-3)
    assert len(same) > 5
    # Ultralytics leaves out boxes whose mask is empty, and only this network has some.
    if file != "yolo26n-seg.yaml":
        assert bool(same.any(1).all())
    if "obb" not in file:
        assert bool(same.any(0).all())
