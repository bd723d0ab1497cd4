"""Reads networks of Hugging Face transformers; imports no transformers.

They come in its own folders, or in files of RF-DETR's trainer (rfdetr). transformers has the same
network as rfdetr and renames its weights.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from torch import Tensor

from skyproof.detectors.blueprint import FOLDER_FILES, TIMM, check_configuration
from skyproof.detectors.checkpoints import Checkpoint, ReadNetwork, StandIn, class_positions
from skyproof.documents import check_document, read_document
from skyproof.errors import ConfigurationError, StoredFileError

REMEDY = "give the folder as save_pretrained of the model and of its image processor writes it"
# A tensor that only these networks have.
_MARK = "transformer.enc_output.0.weight"
# Parts without which boxes are found all the same.
_UNUSED = ("segmentation_head.", "_kp_active_mask")
_RF_DETR_REMEDY = (
    "give checkpoint_best_ema.pth or checkpoint_best_regular.pth of the training, or a folder of "
    "save_pretrained"
)
# rfdetr normalises colours as torchvision does.
_MEAN, _DEVIATION = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]

_Number = Annotated[int, Meta(ge=1, le=64)]


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


class _RfDetrSettings(msgspec.Struct):
    """What does not follow from the weights; `num_windows` is older than its note in the file."""

    resolution: Annotated[int, Meta(ge=32, le=4096)]
    sa_nheads: _Number
    ca_nheads: _Number
    dec_n_points: _Number
    out_feature_indexes: Annotated[list[_Number], Meta(min_length=1, max_length=12)]
    num_windows: Annotated[int, Meta(ge=1, le=16)] = 4
    class_names: list[str] | None = None


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


def is_rf_detr(state: Mapping[str, Tensor]) -> bool:
    """Whether weights are those of rfdetr, which Lightning puts below a common prefix."""
    return any(name.endswith(_MARK) for name in state)


def read_rf_detr(checkpoint: Checkpoint, content: Any, state: dict[str, Tensor]) -> ReadNetwork:
    """Reads the network as `read_folder` does; what no box needs leaves `state`.

    Classes are numbers (COCO: 3 car) without `model_config`: older names may begin at row 1.
    """
    path = checkpoint.path
    if any("projector.stages.1." in name for name in state):
        raise StoredFileError(
            f"{path} holds an RF-DETR of several levels, as the first Large was, and one level is "
            "expected; export it to ONNX, which skyproof assess tests as a black box."
        )
    noted = {**_fields(content, "args"), **_fields(content, "model_config")}
    known = {name: noted[name] for name in _RfDetrSettings.__struct_fields__ if name in noted}
    settings: Any = check_document(
        known, _RfDetrSettings, f"the settings in {path}", _RF_DETR_REMEDY
    )
    try:
        prefix = next(name.removesuffix(_MARK) for name in state if name.endswith(_MARK))
        bare = {name.removeprefix(prefix): tensor for name, tensor in state.items()}
        state.clear()
        state.update({name: bare[name] for name in bare if not name.startswith(_UNUSED)})
        below = "backbone.0.encoder.encoder."
        positions = state[f"{below}embeddings.position_embeddings"]
        patches = state[f"{below}embeddings.patch_embeddings.projection.weight"]
        queries, width = state["query_feat.weight"].shape
        groups = _count(state, "transformer.enc_output.")
        rows = min(len(state["class_embed.bias"]), 5001)
        hidden, patch_px = len(patches), patches.shape[-1]
        network = {
            "model_type": "rf_detr",
            "d_model": width,
            "decoder_ffn_dim": len(state["transformer.decoder.layers.0.linear1.bias"]),
            "decoder_layers": _count(state, "transformer.decoder.layers."),
            "num_queries": queries // groups,
            "group_detr": groups,
            "decoder_self_attention_heads": settings.sa_nheads,
            "decoder_cross_attention_heads": settings.ca_nheads,
            "decoder_n_points": settings.dec_n_points,
            # As in rfdetr; the library's own default is ten times as large.
            "layer_norm_eps": 1e-6,
        }
        backbone = {
            "model_type": "rf_detr_dinov2",
            "hidden_size": hidden,
            "num_hidden_layers": _count(state, f"{below}encoder.layer."),
            "num_attention_heads": hidden // 64,
            "image_size": round((positions.shape[1] - 1) ** 0.5) * patch_px,
            "patch_size": patch_px,
            "num_windows": settings.num_windows,
            "out_indices": settings.out_feature_indexes,
        }
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError) as error:
        raise StoredFileError(
            f"{path} lacks tensors of an RF-DETR that finds boxes ({str(error)[:100]}); "
            f"{_RF_DETR_REMEDY}."
        ) from error
    names = (settings.class_names if _fields(content, "model_config") else None) or []
    classes = [*names[:rows], *map(str, range(min(len(names), rows), rows))]
    plan = {"network": network, "backbone": backbone, "image_mean": _MEAN, "image_std": _DEVIATION}
    vehicles = class_positions(checkpoint.vehicle_classes, classes)
    return ReadNetwork(plan, classes, vehicles, side_px=settings.resolution)


def _fields(content: Any, name: str) -> Mapping[str, Any]:
    found = content.get(name) if isinstance(content, Mapping) else None
    if isinstance(found, StandIn):
        return vars(found)
    return found if isinstance(found, Mapping) else {}


def _count(state: Mapping[str, Tensor], prefix: str) -> int:
    """The number of parts that are numbered after a prefix."""
    found = {name[len(prefix) :].partition(".")[0] for name in state if name.startswith(prefix)}
    return len(found)
