"""A camouflage as a folder: `camouflage.json`, `camouflage.safetensors`, and its maps as PNGs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import read_json, write_beside, write_json
from skyproof.storage import read_tensors, write_tensors

__all__ = ["load_camouflage", "save_camouflage"]

_FORMAT = 2


def save_camouflage(
    folder: Path, camouflage: Camouflage, record: dict[str, Any] | None = None
) -> None:
    """Writes the folder; `camouflage.json` comes last, so a folder that has it is whole.

    Args:
        folder: made if missing.
        camouflage: a texture, a shape or both, finalised.
        record: anything that says where it comes from; kept under "record".

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    folder = Path(folder)
    write_tensors(folder / "camouflage.safetensors", camouflage.state_dict())
    for part in camouflage.modules():
        if isinstance(part, UniversalTexture):
            _write_png(folder / "texture.png", part.bytes().permute(1, 2, 0))
        elif isinstance(part, DisplacementMap):
            _write_png(folder / "displacement.png", (part.map().detach() * 255).round().byte())
    write_json(
        folder / "camouflage.json",
        {"format": _FORMAT, "camouflage": _describe(camouflage), "record": record or {}},
    )


def load_camouflage(folder: str | Path) -> Camouflage:
    """Reads what `save_camouflage` wrote; the camouflage is on the CPU and no longer learnt.

    Raises:
        StoredFileError: a file is missing, damaged or of another version.
    """
    path = Path(folder) / "camouflage.json"
    document = read_json(path)
    described = document.get("camouflage") if isinstance(document, dict) else None
    if described is None or document.get("format") != _FORMAT:
        raise StoredFileError(
            f"{path} was not written by this version of skyproof; make the camouflage again."
        )
    try:
        camouflage = _build(described)
    except (KeyError, TypeError, AttributeError, ValueError, ConfigurationError) as error:
        raise StoredFileError(
            f"{path} is damaged ({error!r}); make the camouflage again."
        ) from error
    weights = Path(folder) / "camouflage.safetensors"
    tensors, _ = read_tensors(weights, "make the camouflage again")
    try:
        camouflage.load_state_dict(tensors)
    except RuntimeError as error:
        raise StoredFileError(
            f"{weights} does not fit camouflage.json ({error}); make the camouflage again."
        ) from error
    return camouflage.requires_grad_(False)


def _describe(camouflage: Camouflage) -> dict[str, Any]:
    """What is needed to build it again, but for its tensors."""
    described: dict[str, Any] = {"kind": type(camouflage).__name__, "name": str(camouflage.name)}
    if isinstance(camouflage, UniversalTexture):
        colours = len(camouflage.palette) if camouflage.restricted else None
        return described | {"blocks": camouflage.blocks, "colours": colours}
    if isinstance(camouflage, DisplacementMap):
        return described | {"frozen_parts": camouflage.frozen_parts}
    if isinstance(camouflage, Combination):
        return described | {
            "texture": _describe(camouflage.texture),
            "shape": _describe(camouflage.shape),
            "turn_steps": camouflage.turn_steps,
        }
    return described


def _build(described: dict[str, Any]) -> Camouflage:
    kind = described["kind"]
    name = CamouflageName.parse(described["name"])
    if kind == "UniversalTexture":
        colours = described["colours"]
        fixed = name.constraints is not None and name.constraints.colours == "fixed"
        return UniversalTexture(
            name,
            generator=torch.Generator().manual_seed(0),
            palette=torch.zeros(colours, 3) if fixed else None,
            colours=colours or 2,
            blocks=described["blocks"],
        )
    if kind == "DisplacementMap":
        return DisplacementMap(name, frozen_parts=described["frozen_parts"])
    if kind == "Combination":
        texture = _build(described["texture"])
        shape = _build(described["shape"])
        if isinstance(texture, UniversalTexture) and isinstance(shape, DisplacementMap):
            return Combination(name, texture, shape, turn_steps=described["turn_steps"])
    raise ValueError(f"kind {kind!r} is unknown to this version")


def _write_png(path: Path, pixels: Tensor) -> None:
    with write_beside(path) as temporary:
        Image.fromarray(pixels.cpu().numpy()).save(temporary)
