"""Small untrained networks of transformers, in folders as `save_pretrained` writes them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
import torch

needs_transformers = pytest.mark.skipif(
    importlib.util.find_spec("transformers") is None, reason="transformers is not installed"
)
CLASSES = ["car", "van", "boat"]
SIDE_PX = 128

_STAGES = ["stage2", "stage3", "stage4"]
_RESNET = {
    "embedding_size": 16,
    "hidden_sizes": [16, 32, 32, 64],
    "depths": [1, 1, 1, 1],
    "layer_type": "basic",
}
_HGNET = {
    "stem_channels": [3, 8, 8],
    "stage_in_channels": [8, 16, 32, 32],
    "stage_mid_channels": [8, 8, 16, 16],
    "stage_out_channels": [16, 32, 32, 64],
    "stage_num_blocks": [1, 1, 1, 1],
    "stage_numb_of_layers": [1, 1, 1, 1],
    "embedding_size": 8,
    "hidden_sizes": [16, 32, 32, 64],
    "depths": [1, 1, 1, 1],
}
_HEAD = {
    "d_model": 32,
    "encoder_ffn_dim": 64,
    "decoder_ffn_dim": 64,
    "encoder_attention_heads": 4,
    "decoder_attention_heads": 4,
    "decoder_layers": 2,
    "num_queries": 30,
}
_PYRAMID = {
    **_HEAD,
    "encoder_hidden_dim": 32,
    "encoder_in_channels": [32, 32, 64],
    "decoder_in_channels": [32, 32, 32],
}
_GROUPS = {
    "d_model": 32,
    "decoder_ffn_dim": 64,
    "decoder_layers": 2,
    "decoder_n_points": 2,
    "decoder_self_attention_heads": 2,
    "decoder_cross_attention_heads": 4,
    "group_detr": 2,
    "num_queries": 30,
}
_TRANSFORMER = {
    "hidden_size": 32,
    "num_hidden_layers": 4,
    "num_attention_heads": 2,
    "patch_size": 16,
    "out_indices": [2, 4],
}
_ONE_LEVEL = {**_RESNET, "model_type": "resnet", "out_features": ["stage4"]}
_LEVELS = {**_RESNET, "model_type": "resnet", "out_features": _STAGES}
# The class of the network, its settings, and those of its backbone.
FAMILIES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "rt_detr": (
        "RTDetr",
        _PYRAMID,
        {**_RESNET, "model_type": "rt_detr_resnet", "out_features": _STAGES},
    ),
    "rt_detr_v2": (
        "RTDetrV2",
        _PYRAMID,
        {**_RESNET, "model_type": "rt_detr_resnet", "out_features": _STAGES},
    ),
    "d_fine": (
        "DFine",
        {**_PYRAMID, "decoder_n_points": [2, 2, 2]},
        {**_HGNET, "model_type": "hgnet_v2", "out_features": _STAGES},
    ),
    "detr": ("Detr", {**_HEAD, "encoder_layers": 1}, _ONE_LEVEL),
    "conditional_detr": ("ConditionalDetr", {**_HEAD, "encoder_layers": 1}, _ONE_LEVEL),
    "deformable_detr": (
        "DeformableDetr",
        {**_HEAD, "encoder_layers": 1, "num_feature_levels": 3},
        _LEVELS,
    ),
    "deimv2": (
        "Deimv2",
        {**_PYRAMID, "decoder_n_points": [2, 2, 2]},
        {**_HGNET, "model_type": "hgnet_v2", "out_features": _STAGES},
    ),
    "deimv2 on dinov3_vit": (
        "Deimv2",
        {
            **_PYRAMID,
            "decoder_n_points": [2, 2, 2],
            "encoder_in_channels": [32, 32, 32],
            "spatial_tuning_adapter_inplanes": 8,
        },
        {**_TRANSFORMER, "model_type": "dinov3_vit", "out_indices": [2, 3, 4]},
    ),
    "lw_detr": (
        "LwDetr",
        {**_GROUPS, "projector_scale_factors": [2.0, 0.5]},
        {
            **_TRANSFORMER,
            "model_type": "lw_detr_vit",
            "image_size": SIDE_PX,
            "window_block_indices": [0, 2],
            "num_windows": 4,
        },
    ),
    "rf_detr": (
        "RfDetr",
        _GROUPS,
        {
            **_TRANSFORMER,
            "model_type": "rf_detr_dinov2",
            # Heads of 64 numbers, as in all DINOv2.
            "hidden_size": 64,
            "num_attention_heads": 1,
            "image_size": SIDE_PX,
            "num_windows": 2,
        },
    ),
}


def write_folder(
    folder: Path, family: str, classes: list[str] = CLASSES, *, fresh: bool = False, **fields: Any
) -> Any:
    """Writes a folder with random weights, and returns the library's own network."""
    import transformers

    name, settings, backbone = FAMILIES[family]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        configuration = getattr(transformers, f"{name}Config")(
            **settings | fields,
            backbone_config=backbone,
            use_timm_backbone=False,
            id2label=dict(enumerate(classes)),
            label2id={each: index for index, each in enumerate(classes)},
        )
        network = getattr(transformers, f"{name}ForObjectDetection")(configuration).eval()
        # Fresh queries all answer alike.
        with torch.no_grad():
            for part, parameter in () if fresh else network.named_parameters():
                if "query_position_embeddings" in part:
                    parameter.normal_(std=3.0)
                elif "class" in part:
                    # Weak answers would be dropped.
                    parameter.normal_(std=0.3) if parameter.ndim > 1 else parameter.zero_()
                elif "bbox" in part and part.endswith("weight"):
                    # These answer with the logarithm of a factor on a side.
                    parameter.normal_(std=0.03 if family in ("lw_detr", "rf_detr") else 0.15)
    others = {"rt_detr_v2": "RTDetr", "d_fine": "RTDetr", "deimv2": "RTDetr"}
    processor = {**others, "lw_detr": "DeformableDetr"}.get(family.split()[0], name)
    side = {"height": SIDE_PX, "width": SIDE_PX}
    network.save_pretrained(folder)
    getattr(transformers, f"{processor}ImageProcessor")(size=side).save_pretrained(folder)
    return network
