"""ONNX files as detectors: the only file that imports onnx and onnxruntime, and only when used.

NOTICE: A stranger's file may ask for operators of other libraries, or for weights in other files.
Here it is read as data first. Only standard operators and weights in the file itself pass, and
onnxruntime gets exactly the content that was checked, for the CPU.
"""

import ast
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torchvision import ops

from skyproof.datasets.pictures import Window
from skyproof.detectors.detector import LOWEST_SCORE
from skyproof.detectors.inference import cores, covering_windows, moved
from skyproof.detectors.ultralytics_detectors import upright
from skyproof.errors import ConfigurationError, DetectorAnswerError, StoredFileError

_DOMAINS = ("", "ai.onnx", "ai.onnx.ml")
_LONGEST_NAMES, _MOST_CLASSES, _MOST_CANDIDATES = 100_000, 5000, 30_000
_INPUT = r"tensor\(float(16)?\) \[((1|None), )?(3|None)(, (\d{3,4}|[4-9]\d|None)){2}\]"
# Ultralytics pads with this grey.
_GREY = 114 / 255


class OnnxFile:
    """The detector of an ONNX file; images are padded to the network's input, or split to fit it.

    Vehicle classes are names, or numbers if the file has no names. `gsd_m` is the resolution that
    the detector was made for; None means that of the metadata, or else of the images. `window_px`
    is the side of what the detector sees at once, in image pixels.

    Raises:
        ConfigurationError: onnxruntime is missing, or the file knows no such class.
        StoredFileError: the file is damaged, not allowed, or no known kind of detector.
    """

    def __init__(
        self, path: Path, vehicle_classes: Sequence[str], gsd_m: float | None, image_gsd_m: float
    ) -> None:
        self._path = path
        try:
            self._session, told = _opened(path)
            self._input, *others = self._session.get_inputs()
            shape = [each if isinstance(each, int) else None for each in self._input.shape]
            if others or not re.fullmatch(_INPUT, f"{self._input.type} {shape}"):
                came = ", ".join(f"{each.type} {each.shape}" for each in (self._input, *others))
                raise ValueError(f"it takes {came[:300]}, not floats [1, 3, height, width]")
            self._fixed_px = shape[-2:]
            self._names = _class_names(told)
            self._iou = float(told.get("det_iou_thresh", 0.7))
            self._stride_px = min(max(int(told.get("stride", 32)), 1), 512)
            gsd_m = gsd_m or float(told.get("resolution", 100 * image_gsd_m)) / 100
            self._scale = image_gsd_m / gsd_m
            if not 0.05 <= self._scale <= 20:
                raise ValueError(f"{gsd_m:g} m per pixel is out of reason")
            self._turned = int(told.get("task") == "obb" or "_obb" in told.get("det_type", ""))
            self._masked = told.get("task") == "segment"
            # This head of Ultralytics gives fractions of the image.
            self._in_fractions = told.get("head") == "RTDETRDecoder"
            trained_px = [int(px) for px in re.findall(r"\d{2,4}", told.get("imgsz", "640")[:100])]
            sides_px = [px for px in self._fixed_px if px] or [max([32, *trained_px])]
            self._side_px = min(sides_px) // 32 * 32
            self.window_px = int(min(max(self._side_px / self._scale, 192), 2048)) // 32 * 32
            self._kind, self._titles, self._classes = self._layout(told.get("end2end") == "True")
        except ImportError as error:
            raise ConfigurationError(
                f"{path} needs onnxruntime, which is not installed: pip install 'skyproof[onnx]'."
            ) from error
        except Exception as error:
            # A stranger's file may fail in any way.
            raise StoredFileError(
                f"{path} is no detector in an ONNX file: {' '.join(str(error).split())[:700]}; "
                "export one with standard operators, its weights, one input [1, 3, height, width] "
                "and outputs of Ultralytics, DETR or torchvision, or give sp.assess a function."
            ) from error
        known = [*self._names.values()] or [*map(str, range(self._classes or _MOST_CLASSES))]
        missing = [each for each in vehicle_classes if each not in known]
        if missing:
            several, others = ", ".join(known)[:500], ", ".join(missing)[:200]
            raise ConfigurationError(f"--vehicle-classes expects some of {several}; got {others}.")

    @torch.no_grad()
    def detect(self, images: Float[Tensor, "B 3 H W"]) -> list[dict[str, Any]]:
        """Returns the `boxes` (pixel xyxy), `scores` and `labels` in each of sRGB images in [0, 1].

        Labels are class names, or numbers as text. A box is returned once for each of its classes.
        """
        size = [max(1, round(side * self._scale)) for side in images.shape[-2:]]
        seen = functional.interpolate(images.cpu().float(), size, mode="bilinear", antialias=True)
        ratio = torch.tensor([*images.shape[:1:-1]] * 2) / torch.tensor(size[::-1] * 2)
        limits = zip(size, self._fixed_px, strict=True)
        whole = all(px <= (fixed or self._side_px) for px, fixed in limits)
        side_px = max(size) if whole else self._side_px
        windows = covering_windows((size[1], size[0]), side_px)
        answers = []
        for image in seen:
            parts = [self._ask(image, *each) for each in zip(windows, cores(windows), strict=True)]
            boxes, scores, numbers = map(torch.cat, zip(*parts, strict=True))
            labels = [self._names.get(each, str(each)) for each in numbers.int().tolist()]
            answers.append({"boxes": boxes * ratio, "scores": scores, "labels": labels})
        return answers

    def _ask(self, image: Tensor, window: Window, core: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Boxes (xyxy in pixels of the image), scores and class numbers in a window's core."""
        left, top, width, height = window
        found = self._read(*self._run(image[:, top : top + height, left : left + width]))
        # A box that lies in the padding shows nothing of the image.
        boxes = ops.clip_boxes_to_image(found[0], (height, width))
        kept = (found[1] >= LOWEST_SCORE) & (boxes[:, 2:] - boxes[:, :2] > 0.5).all(1)
        boxes, inside = moved(boxes, window, core)
        return boxes[kept & inside], found[1][kept & inside], found[2][kept & inside]

    def _run(self, image: Tensor) -> tuple[dict[str, Tensor], int, int]:
        """The outputs for an image, and the height and width that it is padded to."""
        sides = zip(self._fixed_px, image.shape[-2:], strict=True)
        below, right = ((fixed or px + -px % self._stride_px) - px for fixed, px in sides)
        padded = functional.pad(image, (0, right, 0, below), value=_GREY)
        values = padded.half() if self._input.type == "tensor(float16)" else padded
        values = values[None] if len(self._input.shape) == 4 else values
        titles = [each.name for each in self._session.get_outputs()]
        answers = self._session.run(titles, {self._input.name: values.numpy()})
        found = {title: torch.from_numpy(each) for title, each in zip(titles, answers, strict=True)}
        return found, *padded.shape[-2:]

    def _layout(self, ends_only: bool) -> tuple[str, list[str], int]:
        """Returns the outputs' kind, the names of those that count, and the class count or 0."""
        outputs, height, width = self._run(torch.full((3, self._side_px, self._side_px), _GREY))
        known, more = len(self._names), self._turned
        # With masks, each box has one further number for every prototype mask.
        more += sum(each.shape[1] for each in outputs.values() if self._masked and each.ndim == 4)
        cells = [height // stride * (width // stride) for stride in (8, 16, 32, 64)]
        objects, queries, tables = list[Any](), list[Any](), list[Any]()
        for title, output in outputs.items():
            shape = output.shape
            for each, other in outputs.items() if shape[-1:] == (4,) else ():
                classes = other.shape[-1] if other.shape[:-1] == shape[:-1] else -1
                fits = classes - known in (0, 1) if known else classes > 0
                if each != title and fits and ("box" in title or classes != 4):
                    queries.append(("queries", [title, each], known or classes))
            lists = [each for each, other in outputs.items() if other.shape == shape[:-1]]
            # Classes come first: they are whole numbers, or called labels.
            lists.sort(key=lambda each: outputs[each].is_floating_point() - ("label" in each))
            if shape[-1:] == (4,) and len(lists) == 2:
                objects.append(("objects", [title, *lists], known))
            high, wide = shape[1:] if output.ndim == 3 and shape[0] == 1 else (0, 0)
            ends = wide == 6 + more
            # YOLOv5 has three anchors in each cell.
            anchors = high in (3 * sum(cells[:3]), 3 * sum(cells)) and not ends_only
            rows = not more and (wide == 5 + known if known else anchors and wide > 5)
            if high == 4 + known + more if known else 4 + more < high < wide:
                tables.append(("columns", [title], high - 4 - more))
            if rows and (anchors or not ends):
                tables.append(("rows", [title], wide - 5))
            elif ends:
                tables.append(("ends", [title], known))
        found = objects or queries or tables
        if len(found) != 1:
            came = ", ".join(f"{title} {[*output.shape]}" for title, output in outputs.items())
            raise ValueError(f"{len(found)} outputs, not one, fit its {known} class names: {came}")
        return found[0]

    def _read(
        self, outputs: Mapping[str, Tensor], height: int, width: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Boxes (xyxy in pixels of the input), scores and class numbers."""
        first, *rest = [outputs[title].float() for title in self._titles]
        table = first.reshape(first.shape[-2:])
        table = table.T if self._kind == "columns" else table
        boxes, scores, numbers = table[:, :4], table[:, 4 : 4 + self._classes], table[:, :0]
        if self._kind == "objects":
            numbers, scores = (each.flatten() for each in rest)
        elif self._kind == "ends":
            scores, numbers = table[:, 4], table[:, 5]
        elif self._kind == "rows":
            scores = table[:, 5:] * table[:, 4:5]
        elif self._kind == "queries":
            logits = rest[0].reshape(rest[0].shape[-2:])
            # If there is one class more than names, the last one means no object.
            alone = logits.shape[1] == self._classes
            scores = logits.sigmoid() if alone else logits.softmax(1)[:, :-1]
        fractions = self._in_fractions or self._kind == "queries"
        if fractions or self._turned or self._kind in ("columns", "rows"):
            boxes = upright(boxes, table[:, -1:] * self._turned)
        boxes = boxes * torch.tensor([width, height] * 2) if fractions else boxes
        finite = boxes.isfinite().all() and scores.isfinite().all()
        if not finite or (numbers != numbers.round()).any():
            wrong = "broken numbers of classes" if finite else "NaN or infinity"
            raise DetectorAnswerError(f"{self._path} answered {wrong}; export it again.")
        if scores.ndim == 1:
            return boxes, scores, numbers
        places, numbers = (scores >= LOWEST_SCORE).nonzero(as_tuple=True)
        scores = scores[places, numbers]
        best = scores.topk(min(len(scores), _MOST_CANDIDATES)).indices
        best = best[ops.batched_nms(boxes[places[best]], scores[best], numbers[best], self._iou)]
        return boxes[places[best]], scores[best], numbers[best]


def _class_names(told: Mapping[str, str]) -> dict[int, str]:
    """Returns the class names that Ultralytics (as a Python literal) or Deepness (JSON) notes."""
    # A longer text is cut off, so that it is refused below.
    text = (told.get("names") or told.get("class_names") or "{}")[:_LONGEST_NAMES]
    try:
        listed = ast.literal_eval(text) if "names" in told else json.loads(text)
        pairs = listed.items() if isinstance(listed, dict) else enumerate(listed)
        return {int(number): str(name)[:200] for number, name in pairs}
    except Exception as error:
        raise ValueError(f"its names of classes are {text[:100]}") from error


def _opened(path: Path) -> tuple[Any, dict[str, str]]:
    """Opens a file that runs no code and reads no other file; returns session and metadata."""
    import onnx
    import onnxruntime

    if path.stat().st_size >= 2**31:
        raise ValueError("it has 2 GB or more, which the format does not allow")
    model = onnx.load_model_from_string(path.read_bytes())
    # Another version of the format may give a meaning to fields that are unknown here.
    model.DiscardUnknownFields()
    # The list grows during the loop, so bodies of loops, functions and tensors are checked, too.
    waiting: list[Any] = [model]
    for part in waiting:
        if isinstance(part, onnx.NodeProto) and part.domain not in _DOMAINS:
            raise ValueError(f"it asks for {part.op_type[:100]} of {part.domain[:100]}")
        if isinstance(part, onnx.TensorProto) and part.data_location == part.EXTERNAL:
            raise ValueError("it asks for weights in another file")
        for field, value in part.ListFields():
            if field.message_type is not None:
                waiting += [value] if hasattr(value, "ListFields") else value
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = torch.get_num_threads()
    # The same bytes may also be valid in onnxruntime's own format, which was not checked.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    content, providers = model.SerializeToString(), ["CPUExecutionProvider"]
    session = onnxruntime.InferenceSession(content, options, providers)
    return session, {each.key: each.value for each in model.metadata_props}
