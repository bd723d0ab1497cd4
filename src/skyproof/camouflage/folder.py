"""A camouflage as a folder: `camouflage.json`, `camouflage.safetensors`, and the map as `texture.png` to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from skyproof.camouflage.camouflage import Camouflage, NoCamouflage
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_beside, write_bytes, write_json

__all__ = ["load_camouflage", "save_camouflage"]

_FORMAT = 1


def save_camouflage(folder: Path, camouflage: Camouflage, record: dict[str, Any] | None = None) -> None:
    """Writes the folder; `camouflage.json` comes last, so a folder that has it is whole.

    Args:
        folder: made if missing.
        camouflage: finalised.
        record: anything that says where it comes from; kept under "record".

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    folder = Path(folder)
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in camouflage.state_dict().items()}
    write_bytes(folder / "camouflage.safetensors", save(state))
    if isinstance(camouflage, UniversalTexture):
        pixels = (camouflage.texture.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
        with write_beside(folder / "texture.png") as temporary:
            Image.fromarray(pixels).save(temporary)
    write_json(
        folder / "camouflage.json",
        {"format": _FORMAT, "name": camouflage.name, "kind": type(camouflage).__name__, "record": record or {}},
    )


def load_camouflage(folder: Path) -> Camouflage:
    """Reads what `save_camouflage` wrote.

    Raises:
        StoredFileError: a file is missing, damaged or of another version.
    """
    path = Path(folder) / "camouflage.json"
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != _FORMAT or "name" not in document:
        raise StoredFileError(f"{path} was not written by this version of skyproof; make the camouflage again.")
    if document.get("kind") == "NoCamouflage":
        return NoCamouflage()
    if document.get("kind") != "UniversalTexture":
        raise StoredFileError(f"{path} holds a {document.get('kind')!r}, unknown to this version; make it again.")
    if not isinstance(document.get("name"), str):
        raise StoredFileError(f"{path} is damaged (it has no name); make the camouflage again.")
    camouflage = UniversalTexture(document["name"], generator=torch.Generator().manual_seed(0))
    weights = Path(folder) / "camouflage.safetensors"
    try:
        camouflage.load_state_dict(load_file(weights))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise StoredFileError(f"{weights} is missing or damaged ({error}); make the camouflage again.") from error
    return camouflage.requires_grad_(False)
