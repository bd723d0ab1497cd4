"""Reads a checkpoint of RF-DETR's own trainer (rfdetr) as a network of Hugging Face transformers.

transformers has the same network, and renames these weights. Sizes follow from their shapes, the
rest is noted in the file.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from torch import Tensor

from skyproof.detectors.checkpoints import Checkpoint, ReadNetwork, StandIn, class_positions
from skyproof.documents import check_document
from skyproof.errors import StoredFileError

# A tensor that only these networks have.
_MARK = "transformer.enc_output.0.weight"
# Parts without which boxes are found all the same.
_UNUSED = ("segmentation_head.", "_kp_active_mask")
_REMEDY = (
    "give checkpoint_best_ema.pth or checkpoint_best_regular.pth of the training, or a folder of "
    "save_pretrained"
)
# rfdetr normalises colours as torchvision does.
_MEAN, _DEVIATION = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]

_Number = Annotated[int, Meta(ge=1, le=64)]


class _RfDetrSettings(msgspec.Struct):
    """What does not follow from the weights; `num_windows` is older than its note in the file."""

    resolution: Annotated[int, Meta(ge=32, le=4096)]
    sa_nheads: _Number
    ca_nheads: _Number
    dec_n_points: _Number
    out_feature_indexes: Annotated[list[_Number], Meta(min_length=1, max_length=12)]
    num_windows: Annotated[int, Meta(ge=1, le=16)] = 4
    class_names: list[str] | None = None


def is_rf_detr(state: Mapping[str, Tensor]) -> bool:
    """Whether weights are those of rfdetr, which Lightning puts below a common prefix."""
    return any(name.endswith(_MARK) for name in state)


def read_rf_detr(checkpoint: Checkpoint, content: Any, state: dict[str, Tensor]) -> ReadNetwork:
    """Reads the network as `read_folder` does; what no box needs leaves `state`.

    Classes without names are numbers, as in rfdetr's own weights for COCO (3 car, 6 bus, 8 truck).
    """
    path = checkpoint.path
    if any("projector.stages.1." in name for name in state):
        raise StoredFileError(
            f"{path} holds an RF-DETR of several levels, as the first Large was, and one level is "
            "expected; export it to ONNX, which skyproof assess tests as a black box."
        )
    noted = {**_fields(content, "args"), **_fields(content, "model_config")}
    known = {name: noted[name] for name in _RfDetrSettings.__struct_fields__ if name in noted}
    settings: Any = check_document(known, _RfDetrSettings, f"the settings in {path}", _REMEDY)
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
        rows = len(state["class_embed.bias"])
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
            f"{path} lacks tensors of an RF-DETR that finds boxes ({str(error)[:100]}); {_REMEDY}."
        ) from error
    names = settings.class_names or []
    classes = [*names[:rows], *map(str, range(min(len(names), rows), rows))]
    plan = {"network": network, "backbone": backbone, "image_mean": _MEAN, "image_std": _DEVIATION}
    vehicles = class_positions(checkpoint.vehicle_classes, classes)
    return ReadNetwork(plan, classes, vehicles, side_px=settings.resolution)


def _fields(content: Any, name: str) -> Mapping[str, Any]:
    found = content.get(name) if isinstance(content, Mapping) else None
    return (
        vars(found) if isinstance(found, StandIn) else found if isinstance(found, Mapping) else {}
    )


def _count(state: Mapping[str, Tensor], prefix: str) -> int:
    """The number of parts that are numbered after a prefix."""
    found = {name[len(prefix) :].partition(".")[0] for name in state if name.startswith(prefix)}
    return len(found)
