"""Reads a detector's folder as Hugging Face transformers writes it; imports no transformers."""

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from skyproof.detectors.blueprint import FOLDER_FILES, TIMM, check_configuration
from skyproof.detectors.checkpoints import Checkpoint, ReadNetwork, class_positions
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError

REMEDY = "give the folder as save_pretrained of the model and of its image processor writes it"


class _ConfigurationFile(msgspec.Struct):
    """The part of config.json that is read here; the rest goes to the library's own class."""

    model_type: str
    id2label: Annotated[dict[str, str], Meta(min_length=1, max_length=5000)]


class _ProcessorFile(msgspec.Struct):
    """The fields of preprocessor_config.json that decide what the network sees."""

    size: int | dict[str, int | None]
    do_normalize: bool
    image_mean: list[float]
    image_std: list[float]
    image_processor_type: str = ""
    # Its name up to transformers 4.
    feature_extractor_type: str = ""
    do_rescale: bool = True
    rescale_factor: float = 1 / 255

    @property
    def side_px(self) -> int:
        """The side of the square that the network sees, or the shorter side of its images."""
        size = {"shortest_edge": self.size} if isinstance(self.size, int) else self.size
        sides = [size.get("shortest_edge")] if "shortest_edge" in size else [*size.values()]
        whole = {side for side in sides if side is not None and 32 <= side <= 4096}
        if len(whole) != 1 or not {*size} <= {"height", "width", "shortest_edge", "longest_edge"}:
            raise ConfigurationError(
                f"its image processor resizes to {size}, and a square or a shortest edge of 32 to "
                "4096 px is expected; export it to ONNX, which skyproof assess tests."
            )
        return whole.pop()


def read_folder(checkpoint: Checkpoint) -> ReadNetwork:
    """Reads the files beside a folder's weights.

    The architecture holds the fields of config.json ("network" and "backbone") and the mean and
    deviation by which images are normalised.
    """
    path, beside = (checkpoint.path.with_name(name) for name in FOLDER_FILES)
    known: _ConfigurationFile = read_document(path, _ConfigurationFile, REMEDY)
    stored: dict[str, Any] = read_document(path, dict[str, Any], REMEDY)
    classes = [known.id2label.get(str(index), "") for index in range(len(known.id2label))]
    if not all(classes):
        raise StoredFileError(
            f"{path} does not name its classes 0 to {len(classes) - 1} one by one; {REMEDY}."
        )
    processor: _ProcessorFile = read_document(beside, _ProcessorFile, REMEDY)
    kind = processor.image_processor_type or processor.feature_extractor_type
    if "Detr" not in kind:
        raise StoredFileError(
            f"{beside} names the image processor {kind[:100]!r}, and one of a DETR family is "
            f"expected; {REMEDY}."
        )
    if not processor.do_rescale or abs(processor.rescale_factor * 255 - 1) > 1e-3:
        raise StoredFileError(
            f"{beside} does not bring colours from 255 to 1, as networks here expect; {REMEDY}."
        )
    backbone = stored.get("backbone_config")
    if not isinstance(backbone, Mapping):
        # Up to transformers 4, DETR's configuration names a backbone of timm instead.
        backbone = {"model_type": TIMM, "backbone": stored.get("backbone") or "resnet50"}
    normal = processor.do_normalize
    architecture = {
        "network": {"model_type": known.model_type} | _plain(stored),
        "backbone": _plain(backbone),
        "image_mean": processor.image_mean if normal else [0.0] * 3,
        "image_std": processor.image_std if normal else [1.0] * 3,
    }
    check_configuration(architecture)
    vehicles = class_positions(checkpoint.vehicle_classes, classes)
    return ReadNetwork(architecture, classes, vehicles, side_px=processor.side_px)


def _plain(stored: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that may describe a network: names and numbers, and lists of them."""
    return {
        name: value
        for name, value in stored.items()
        if isinstance(value, bool | int | float | str | list | None) and not name.startswith("_")
    }
