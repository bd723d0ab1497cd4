"""A camouflage as a folder: `camouflage.json`, `camouflage.safetensors`, and its maps as PNGs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import msgspec
import torch
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.make import Combination
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import Blocks, Colours
from skyproof.camouflage.texture import UniversalTexture
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import write_json
from skyproof.pictures import write_png
from skyproof.ranges import Count, Name
from skyproof.storage import read_tensors, write_tensors

_FORMAT = 2
_REMEDY = "copy the whole folder again, or make the camouflage again"


def save_camouflage(
    folder: str | Path, camouflage: Camouflage, record: dict[str, Any] | None = None
) -> None:
    """Writes the folder; `camouflage.json` comes last, so a folder that has it is whole.

    The record is JSON values that say where the camouflage comes from.
    """
    folder = Path(folder)
    write_tensors(folder / "camouflage.safetensors", camouflage.state_dict())
    for part in camouflage.modules():
        if isinstance(part, UniversalTexture):
            write_png(folder / "texture.png", part.bytes().permute(1, 2, 0).cpu().numpy())
        elif isinstance(part, DisplacementMap):
            height = (part.map().detach() * 255).round().byte()
            write_png(folder / "displacement.png", height.cpu().numpy())
    write_json(
        folder / "camouflage.json",
        {"format": _FORMAT, "camouflage": describe_camouflage(camouflage), "record": record or {}},
    )


def load_camouflage(folder: str | Path) -> Camouflage:
    """Reads the folder of `save_camouflage`; the camouflage is on the CPU and finished.

    Raises:
        StoredFileError: a file is missing, damaged or of another version.
    """
    described = _read(folder).camouflage
    try:
        camouflage = _build(described)
    except ConfigurationError as error:
        raise StoredFileError(
            f"{Path(folder) / 'camouflage.json'} does not hold together "
            f"({' '.join(str(error).split()).rstrip('.')[:200]}); {_REMEDY}."
        ) from error
    weights = Path(folder) / "camouflage.safetensors"
    tensors, _ = read_tensors(weights, _REMEDY)
    misfit = _misfit(camouflage.state_dict(), tensors)
    if misfit:
        raise StoredFileError(f"{weights} does not fit camouflage.json ({misfit}); {_REMEDY}.")
    camouflage.load_state_dict(tensors)
    return camouflage.requires_grad_(False)


def read_record(folder: Path) -> dict[str, Any]:
    """Reads the record that `save_camouflage` was given; errors as in `load_camouflage`."""
    return _read(folder).record


class _Texture(msgspec.Struct, tag_field="kind", tag="UniversalTexture"):
    name: Name
    blocks: Blocks
    colours: Colours | None


class _Shape(msgspec.Struct, tag_field="kind", tag="DisplacementMap"):
    name: Name
    frozen_parts: bool


class _Both(msgspec.Struct, tag_field="kind", tag="Combination"):
    name: Name
    texture: _Texture
    shape: _Shape
    turn_steps: Count | None


class _StoredCamouflage(msgspec.Struct):
    """What `camouflage.json` holds beside its format."""

    camouflage: _Texture | _Shape | _Both
    record: dict[str, Any] = {}


def _read(folder: str | Path) -> _StoredCamouflage:
    path = Path(folder) / "camouflage.json"
    return read_document(path, _StoredCamouflage, _REMEDY, version=_FORMAT)


def _misfit(wanted: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> str:
    """Names the first difference between two sets of tensors; empty if there is none."""
    for name, tensor in wanted.items():
        if name not in given:
            return f"it lacks {name}"
        if given[name].shape != tensor.shape:
            return f"{name} has the shape {[*given[name].shape]}, expected {[*tensor.shape]}"
    return next((f"it holds {name[:100]!r} too" for name in given if name not in wanted), "")


def describe_camouflage(camouflage: Camouflage) -> dict[str, Any]:
    """Returns what, besides its tensors, is needed to build a camouflage again, as JSON values."""
    return msgspec.to_builtins(_described(camouflage))


def _described(camouflage: Camouflage) -> _Texture | _Shape | _Both:
    name = str(camouflage.name)
    if isinstance(camouflage, Combination):
        texture, shape = _described(camouflage.texture), _described(camouflage.shape)
        return _Both(name, cast(_Texture, texture), cast(_Shape, shape), camouflage.turn_steps)
    if isinstance(camouflage, UniversalTexture):
        colours = len(camouflage.palette) if camouflage.restricted else None
        return _Texture(name, camouflage.blocks, colours)
    assert isinstance(camouflage, DisplacementMap)
    return _Shape(name, camouflage.frozen_parts)


def _build(described: _Texture | _Shape | _Both) -> Camouflage:
    name = CamouflageName.parse(described.name)
    if isinstance(described, _Both):
        texture, shape = _build(described.texture), _build(described.shape)
        assert isinstance(texture, UniversalTexture)
        assert isinstance(shape, DisplacementMap)
        return Combination(name, texture, shape, turn_steps=described.turn_steps)
    if isinstance(described, _Shape):
        return DisplacementMap(name, frozen_parts=described.frozen_parts)
    kind = "free" if name.constraints is None else name.constraints.colours
    if (described.colours is None) != (kind == "free"):
        raise ConfigurationError(f"{name} expects {kind} colours, got {described.colours}.")
    return UniversalTexture(
        name,
        generator=torch.Generator().manual_seed(0),
        palette=torch.zeros(described.colours or 0, 3) if kind == "fixed" else None,
        colours=described.colours or 2,
        blocks=described.blocks,
    )
