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
}


def write_folder(
    folder: Path, family: str, classes: list[str] = CLASSES, *, fresh: bool = False
) -> Any:
    """Writes a folder with random weights, and returns the library's own network."""
    import transformers

    name, settings, backbone = FAMILIES[family]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        configuration = getattr(transformers, f"{name}Config")(
            **settings,
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
                elif "class" in part and part.endswith("weight"):
                    parameter.normal_(std=0.3)
                elif "bbox" in part and part.endswith("weight"):
                    parameter.normal_(std=0.15)
    processor = {"rt_detr_v2": "RTDetr", "d_fine": "RTDetr"}.get(family, name)
    side = {"height": SIDE_PX, "width": SIDE_PX}
    network.save_pretrained(folder)
    getattr(transformers, f"{processor}ImageProcessor")(size=side).save_pretrained(folder)
    return network
