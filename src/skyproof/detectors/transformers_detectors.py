"""Detectors of Hugging Face transformers: the only file that imports it.

Networks are built without code of the folders that they come from (`transformers_files`) and
without a connection: only the families that `blueprint` lists, and only from the fields that their
configurations declare.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from skyproof.detectors.blueprint import TIMM, Blueprint
from skyproof.detectors.checkpoints import ReadNetwork
from skyproof.detectors.cost import SIDE_PX, Meter, measured
from skyproof.detectors.query_detector import Answers, QueryDetector
from skyproof.detectors.transformers_files import REMEDY
from skyproof.errors import ConfigurationError

# Published networks need at most 360 px for as many patches as queries.
_LARGEST_BLANK_PX = 1024


class TransformersNetwork(QueryDetector):
    """A DETR, RT-DETR or relative. For training, the library cuts gradients between its parts."""

    def __init__(self, blueprint: Blueprint, side_px: int) -> None:
        plan: Any = blueprint.architecture
        super().__init__(blueprint.vehicle_classes, len(blueprint.classes), side_px)
        self.colours = (plan["image_mean"], plan["image_std"])
        with _offline():
            configuration, kind = _configured(plan, self.classes)
            self.model = kind(configuration).eval()
            least_px = SIDE_PX
            if configuration.model_type in ("lw_detr", "rf_detr"):
                backbone = configuration.backbone_config
                windows = getattr(backbone, "num_windows_side", backbone.num_windows)
                # Attention is within windows, and each query stems from a patch of its own.
                self.stride_px, self.focal_weight = windows * backbone.patch_size, 1.0
                least_px = max(SIDE_PX, backbone.patch_size * math.sqrt(configuration.num_queries))
            elif configuration.model_type == "deimv2":
                self.focal_weight = configuration.mal_alpha or 1.0
                self.focal_exponent = configuration.focal_loss_gamma
            # Not all families can be measured without memory for their numbers.
            side = math.ceil(least_px / self.stride_px) * self.stride_px
            if side > _LARGEST_BLANK_PX:
                raise ConfigurationError("no detector needs patches or windows so large.")
            blank = torch.zeros(1, 3, side, side)
            with torch.no_grad(), Meter():
                if self.features(blank)[0].shape[-1] > side // 4:
                    raise ConfigurationError("no detector needs features finer than every 4 px.")
                self.model(pixel_values=blank)
        # Some families hold a layer under two names, which one file cannot.
        self.model.register_state_dict_post_hook(_drop_second_names)
        self.model.register_load_state_dict_pre_hook(_restore_second_names)

    def answers(self, seen: Tensor) -> Answers:
        with _WholeGradient():
            found = self.model(pixel_values=seen)
        return Answers(found.logits, found.pred_boxes)

    def cost(self, seen: Tensor, classes: Tensor, boxes: Tensor) -> Tensor:
        truth = {"class_labels": classes, "boxes": boxes}
        loss: Tensor = self.model(pixel_values=seen, labels=[truth]).loss
        return loss

    def features(self, seen: Tensor) -> list[Tensor]:
        parts = self.model.model
        if hasattr(parts, "conv_encoder"):
            levels: list[Tensor] = parts.conv_encoder(seen)
            return levels
        found = parts.backbone(seen, seen.new_ones(seen[:, 0].shape))
        # RF-DETR answers with one level and its mask, others with a list of such pairs.
        return [features for features, _ in ([found] if isinstance(found, tuple) else found)]


class _WholeGradient(TorchFunctionMode):
    """Lets gradients through where the library's code detaches a tensor."""

    def __torch_function__(self, function: Any, _: Any, args: Any = (), named: Any = None) -> Any:
        return args[0] if function is Tensor.detach else function(*args, **(named or {}))


def converted_weights(
    plan: ReadNetwork, state: Mapping[str, Tensor], path: Path, source: str
) -> dict[str, Tensor]:
    """Returns a file's weights under the names of the network; the library renames older ones.

    `source` says where the architecture stands.

    Raises:
        ConfigurationError: tensors are missing, superfluous or of another shape.
    """
    with _offline(), torch.random.fork_rng(devices=[]):
        configuration, kind = _configured(plan.architecture, len(plan.classes))
        network, told = kind.from_pretrained(
            None,
            config=configuration,
            state_dict=dict(state),
            output_loading_info=True,
            ignore_mismatched_sizes=True,
        )
    # Missing, superfluous and mismatched tensors, the latter with their shapes.
    named = (
        each if isinstance(each, str) else each[0] for found in told.values() for each in found
    )
    different = sorted({name for name in named if not name.endswith("num_batches_tracked")})
    if different:
        raise ConfigurationError(
            f"The weights of {path} do not fit {source}: {len(different)} tensors differ, such as "
            f"{different[0][:200]}; {REMEDY}."
        )
    weights: dict[str, Tensor] = network.state_dict()
    _drop_second_names(network, weights, "", {})
    return weights


def _configured(architecture: Any, classes: int) -> tuple[Any, Any]:
    """Returns the library's configuration and the class of the network, whose size is checked.

    Only fields that the configuration's class declares are passed on. None of them names a file, a
    repository or code, which the fields of the base class do.
    """
    from transformers import AutoModelForObjectDetection
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    network, backbone = architecture["network"], architecture["backbone"]
    own: Any = CONFIG_MAPPING[network["model_type"]]
    fields = _declared(own, network)
    if backbone["model_type"] == TIMM:
        fields |= {"use_timm_backbone": True, "backbone": backbone["backbone"]}
    else:
        below: Any = CONFIG_MAPPING[backbone["model_type"]]
        kept = _declared(below, backbone, also=("out_features", "out_indices"))
        fields["backbone_config"] = below(**kept)
    # Anchors follow from the images' sides.
    sizes = {name: None for name in ("eval_size", "anchor_image_size") if name in fields}
    configuration = own(**fields | sizes, num_labels=classes)
    kind: Any = AutoModelForObjectDetection._model_mapping[own]
    with measured():
        kind(configuration)
    return configuration, kind


def _declared(kind: Any, given: Mapping[str, Any], also: Sequence[str] = ()) -> dict[str, Any]:
    return {name: given[name] for name in (*kind.__annotations__, *also) if name in given}


def _drop_second_names(
    network: torch.nn.Module, state: dict[str, Tensor], prefix: str, _: Any
) -> None:
    for second in _second_names(network):
        state.pop(prefix + second, None)


def _restore_second_names(
    network: torch.nn.Module, state: dict[str, Tensor], prefix: str, *_: Any
) -> None:
    for second, first in _second_names(network).items():
        if prefix + first in state:
            state[prefix + second] = state[prefix + first]


def _second_names(network: torch.nn.Module) -> dict[str, str]:
    """Maps the further names of a network's parameters and buffers to the first ones."""
    first = dict[int, str]()
    parameters = network.named_parameters(remove_duplicate=False)
    named = (*parameters, *network.named_buffers(remove_duplicate=False))
    return {
        name: first[id(tensor)]
        for name, tensor in named
        if first.setdefault(id(tensor), name) != name
    }


@contextmanager
def _offline() -> Iterator[None]:
    """Imports transformers, meanwhile offline and quiet; its errors become one sentence."""
    try:
        from huggingface_hub import constants
        from transformers.utils import logging
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            "a folder of Hugging Face needs transformers, which is not installed: "
            'pip install "skyproof[transformers]".'
        ) from error
    offline, level = constants.HF_HUB_OFFLINE, logging.get_verbosity()
    bars = logging.is_progress_bar_enabled()
    constants.HF_HUB_OFFLINE = True
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    except ConfigurationError:
        raise
    except Exception as error:
        # A row of numbers can raise any exception in another library.
        why = " ".join(str(error).split()).partition(". ")[0][:200]
        raise ConfigurationError(
            f"the installed transformers cannot build the network ({why}); check its config.json, "
            "or install the version that trained it."
        ) from error
    finally:
        constants.HF_HUB_OFFLINE = offline
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
