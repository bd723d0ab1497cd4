"""Detectors of Hugging Face transformers: the only file that imports it.

Networks are built without code of the folders that they come from (`transformers_folder`) and
without a connection: only the families that `blueprint` lists, and only from the fields that their
configurations declare.
"""

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torchvision.ops import box_convert, box_iou

from skyproof.detectors.blueprint import check_configuration
from skyproof.detectors.cost import measured
from skyproof.detectors.detector import (
    PADDING_GREY,
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.transformers_folder import REMEDY, TIMM
from skyproof.errors import ConfigurationError

# Weight and exponent of a query without a vehicle in the libraries' focal and varifocal losses.
_FOCAL_WEIGHT = 0.75
_FOCAL_EXPONENT = 2
_STRIDE_PX = 32
# What the library tells of weights that do not fit.
_LOADING = ("missing_keys", "unexpected_keys", "mismatched_keys")


class TransformersNetwork(TrainableDetector):
    """A DETR, RT-DETR or relative: each query answers with one box and a score of each class.

    Boxes are shares of the image's sides, so smaller images are padded to `side_px`, the side in
    training. Answers are not suppressed. For training, the library cuts gradients between encoder,
    queries and layers; for attacks they go all the way. Dropout stays off, in training as well.
    """

    name = "transformers"
    size = "brought"
    suppression_iou = 1.0

    def __init__(
        self,
        architecture: Mapping[str, Any],
        vehicle_classes: Sequence[int],
        classes: int,
        side_px: int,
    ) -> None:
        super().__init__()
        self.vehicle_classes = list(vehicle_classes)
        self.side_px = side_px
        self.model = build_network(architecture, classes)
        self._colours = (architecture["image_mean"], architecture["image_std"])
        self._classes = classes
        # Some families hold a layer under two names, which one file cannot.
        self.model.register_state_dict_post_hook(_drop_second_names)
        self.model.register_load_state_dict_pre_hook(_restore_second_names)

    def train(self, mode: bool = True) -> "TransformersNetwork":
        """Keeps the network as it infers: without dropout, and without noised queries."""
        super().train(False)
        return self

    def candidates(self, images: Images) -> Candidates:
        """Every query's box and its score of the likeliest vehicle class."""
        seen, sides = self._seen(images)
        with _WholeGradient():
            answers = self.model(pixel_values=seen)
        boxes = box_convert(answers.pred_boxes, "cxcywh", "xyxy") * sides
        if self._tells_nothing(answers.logits):
            scores = answers.logits.softmax(dim=-1)[..., self.vehicle_classes].amax(dim=-1)
        else:
            scores = answers.logits[..., self.vehicle_classes].amax(dim=-1).sigmoid()
        return Candidates(boxes, scores, torch.ones_like(scores, dtype=torch.bool))

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """The library's own loss of each image, and for an empty truth its part for the queries.

        With an empty truth every query of the last layer should answer "no vehicle": the focal
        term of each vehicle class, summed as the library does; for DETR, whose softmax has a class
        "nothing", minus the log of the share of the other classes, summed where the library
        averages. Where a network tells several vehicle classes apart, the likeliest one of the
        query that overlaps a vehicle most is the right one.
        """
        check_targets(images, targets)
        seen, sides = self._seen(images)
        if not any(map(len, targets)):
            with _WholeGradient():
                return self._doubt(self.model(pixel_values=seen).logits)
        losses = []
        for image, boxes in zip(seen.split(1), targets, strict=True):
            if not len(boxes):
                losses.append(self._doubt(self.model(pixel_values=image).logits)[0])
                continue
            wanted = boxes.to(sides) / sides
            truth = {
                "class_labels": self._likeliest(image, wanted),
                "boxes": box_convert(wanted, "xyxy", "cxcywh"),
            }
            losses.append(self.model(pixel_values=image, labels=[truth]).loss)
        return torch.stack(losses)

    @torch.no_grad()
    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; the features are those of the backbone."""
        seen, _ = self._seen(images)
        whole = seen.new_ones(seen[:, 0].shape)
        levels = self.model.model.backbone(seen, whole)
        return [features for features, _ in levels], seen.shape[-1]

    def _tells_nothing(self, logits: Tensor) -> bool:
        """Whether the last class is "nothing", as in DETR."""
        return logits.shape[-1] == self._classes + 1

    def _doubt(self, logits: Tensor) -> Float[Tensor, " B"]:
        vehicles = logits[..., self.vehicle_classes]
        if self._tells_nothing(logits):
            others = [each for each in range(logits.shape[-1]) if each not in self.vehicle_classes]
            odds = vehicles.logsumexp(dim=-1) - logits[..., others].logsumexp(dim=-1)
            return functional.softplus(odds).sum(dim=-1)
        weight = _FOCAL_WEIGHT * vehicles.sigmoid() ** _FOCAL_EXPONENT
        return (weight * functional.softplus(vehicles)).sum(dim=(1, 2))

    @torch.no_grad()
    def _likeliest(self, image: Tensor, boxes: Tensor) -> Tensor:
        """Each box's vehicle class: the likeliest one of the query that overlaps it most."""
        known = torch.tensor(self.vehicle_classes, device=image.device)
        if len(known) == 1:
            return known.expand(len(boxes))
        answers = self.model(pixel_values=image)
        overlaps = box_iou(box_convert(answers.pred_boxes[0], "cxcywh", "xyxy"), boxes)
        return known[answers.logits[0, overlaps.argmax(dim=0)][:, known].argmax(dim=1)]

    def _seen(self, images: Images) -> tuple[Tensor, Tensor]:
        """Pads right and below to the side in training, and normalises; also returns the sides."""
        check_images(images)
        height, width = images.shape[-2:]
        margins = (0, max(0, self.side_px - width), 0, max(0, self.side_px - height))
        padded = functional.pad(images, margins, value=PADDING_GREY)
        padded = pad_to_stride(padded, value=PADDING_GREY, stride_px=_STRIDE_PX)
        mean, deviation = (images.new_tensor(each).view(3, 1, 1) for each in self._colours)
        sides = images.new_tensor([padded.shape[-1], padded.shape[-2]] * 2)
        return (padded - mean) / deviation, sides


class _WholeGradient(TorchFunctionMode):
    """Lets gradients through where the library's code detaches a tensor."""

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        if function is Tensor.detach:
            return args[0]
        return function(*args, **(kwargs or {}))


def converted_weights(
    architecture: Mapping[str, Any], classes: int, state: Mapping[str, Tensor], path: Path
) -> dict[str, Tensor]:
    """Returns a file's weights under the names of the network; the library renames older ones.

    Raises:
        ConfigurationError: tensors are missing, superfluous or of another shape.
    """
    with _offline(), torch.random.fork_rng(devices=[]):
        configuration, kind = _configured(architecture, classes)
        try:
            network, told = kind.from_pretrained(
                None,
                config=configuration,
                state_dict=dict(state),
                output_loading_info=True,
                ignore_mismatched_sizes=True,
            )
        except Exception as error:
            raise _not_built(error) from error
    different = sorted({str(each) for name in _LOADING for each in told[name]})
    if different:
        raise ConfigurationError(
            f"The weights of {path} do not fit its config.json: {len(different)} tensors differ, "
            f"such as {different[0][:200]}; {REMEDY}."
        )
    weights: dict[str, Tensor] = network.state_dict()
    _drop_second_names(network, weights, "", {})
    return weights


def build_network(architecture: Mapping[str, Any], classes: int) -> Any:
    """Builds a stranger's network, checked by `check_configuration`, without its weights."""
    check_configuration(architecture)
    with _offline():
        configuration, kind = _configured(architecture, classes)
        return kind(configuration)


def _not_built(error: Exception) -> ConfigurationError:
    # A row of numbers can raise any exception in another library.
    return ConfigurationError(
        f"the installed transformers cannot build the network ({' '.join(str(error).split())[:200]}"
        "); install the version that trained it."
    )


def _configured(architecture: Mapping[str, Any], classes: int) -> tuple[Any, Any]:
    """Returns the library's configuration and the class of the network, whose size is checked.

    Only fields that the configuration's class declares are passed on. None of them names a file, a
    repository or code, which the fields of the base class do.
    """
    from transformers import AutoModelForObjectDetection
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    network, backbone = architecture["network"], architecture["backbone"]
    try:
        own: Any = CONFIG_MAPPING[network["model_type"]]
        fields = _declared(own, network)
        if backbone["model_type"] == TIMM:
            fields |= {"use_timm_backbone": True, "backbone": backbone["backbone"]}
        else:
            below: Any = CONFIG_MAPPING[backbone["model_type"]]
            kept = _declared(below, backbone, also=("out_features", "out_indices"))
            fields["backbone_config"] = below(**kept)
        # Anchors follow from the images' sides, and no query is noised.
        sizes = {name: None for name in ("eval_size", "anchor_image_size") if name in fields}
        configuration = own(**fields | sizes, num_labels=classes)
        kind: Any = AutoModelForObjectDetection._model_mapping[own]
        with measured():
            kind(configuration)
    except ConfigurationError:
        raise
    except Exception as error:
        raise _not_built(error) from error
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
    named = (
        *network.named_parameters(remove_duplicate=False),
        *network.named_buffers(remove_duplicate=False),
    )
    return {
        name: first[id(tensor)]
        for name, tensor in named
        if first.setdefault(id(tensor), name) != name
    }


@contextmanager
def _offline() -> Iterator[None]:
    """Imports transformers, which then neither loads files from its hub nor prints."""
    environment = dict(os.environ)
    os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        from transformers.utils import logging

        level = logging.get_verbosity()
        logging.set_verbosity_error()
        bars = logging.is_progress_bar_enabled()
        logging.disable_progress_bar()
        try:
            with warnings.catch_warnings(action="ignore"):
                yield
        finally:
            logging.set_verbosity(level)
            if bars:
                logging.enable_progress_bar()
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            "a folder of Hugging Face needs transformers, which is not installed: "
            'pip install "skyproof[transformers]".'
        ) from error
    finally:
        os.environ.clear()
        os.environ.update(environment)
