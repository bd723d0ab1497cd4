"""Checkpoint files of other programs, opened without running anything that stands in them.

NOTICE: a checkpoint as `torch.save` writes it is a pickle, and opening a pickle in the usual way
runs whatever its author put into it. Here every class and function that a file names, but for
tensors and plain containers, is replaced by an inert stand-in, and what is left is read as data:
nothing of the file runs, and no library of its author is needed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from skyproof.errors import StoredFileError

__all__ = ["StandIn", "network_of", "read_checkpoint", "state_of"]

# An averaged network is the one that is used.
_WRAPPINGS = ("ema", "model", "state_dict", "model_state_dict")
# Of a network wrapped for several devices, or compiled.
_PREFIXES = ("module.", "_orig_mod.")


class StandIn:
    """An object of a foreign class: its attributes, and no behaviour.

    Attributes:
        origin: dotted name of its class in the program that stored it.
    """

    origin: str = ""

    def __new__(cls, *arguments: Any, **named: Any) -> StandIn:
        return object.__new__(cls)

    def __init__(self, *arguments: Any, **named: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


def read_checkpoint(path: Path) -> Any:
    """Reads what a `.safetensors` file or a file of `torch.save` holds.

    Tensors come on the CPU, foreign objects as `StandIn`.

    Raises:
        StoredFileError: the file is missing, no checkpoint, damaged, or names what no checkpoint
            needs.
    """
    path = Path(path)
    if not path.is_file():
        raise StoredFileError(f"{path} is missing; give a checkpoint file.")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        names = _foreign_names(path)
        stand_ins = [
            (type(name.rpartition(".")[2], (StandIn,), {"origin": name}), name) for name in names
        ]
        with torch.serialization.safe_globals(stand_ins):  # type: ignore[arg-type]
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # Unpicklers meet damage with any exception there is.
        reason = str(error).split("\n")[0][:200]
        raise StoredFileError(
            f"{path} is not a checkpoint that can be read ({reason}); give a file as torch.save or "
            "safetensors write it, with the weights in it."
        ) from error


def network_of(content: Any) -> Any:
    """Finds the state dict or stored network in what `read_checkpoint` gives.

    It is `content` itself where that wraps none.
    """
    if isinstance(content, Mapping):
        wrapped = (content.get(key) for key in _WRAPPINGS)
        return next((value for value in wrapped if isinstance(value, Mapping | StandIn)), content)
    return content


def state_of(network: Any) -> dict[str, Tensor]:
    """Parameters and buffers by name, in float32: of a state dict or a whole stored network.

    Returns:
        Names to tensors; empty where there are none.
    """
    if isinstance(network, StandIn):
        found = dict(_walk(network))
    else:
        items = network.items() if isinstance(network, Mapping) else ()
        found = {str(name): value for name, value in items if isinstance(value, Tensor)}
    for prefix in _PREFIXES:
        if found and all(name.startswith(prefix) for name in found):
            found = {name.removeprefix(prefix): value for name, value in found.items()}
    # Ultralytics stores halves.
    return {
        name: value.detach().float() if value.is_floating_point() else value
        for name, value in found.items()
    }


def _foreign_names(path: Path) -> list[str]:
    """Lists the dotted names that the unpickler would refuse.

    None are listed in the form of before 2020, where it refuses them itself.
    """
    return (
        torch.serialization.get_unsafe_globals_in_checkpoint(str(path))
        if zipfile.is_zipfile(path)
        else []
    )


def _walk(module: StandIn, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """A stored network's tensors under the names its state dict would give them."""
    values = vars(module)
    fleeting = values.get("_non_persistent_buffers_set") or ()
    for kind in ("_parameters", "_buffers"):
        for name, value in (values.get(kind) or {}).items():
            if isinstance(value, Tensor) and not (kind == "_buffers" and name in fleeting):
                yield prefix + name, value
    for name, child in (values.get("_modules") or {}).items():
        if isinstance(child, StandIn):
            yield from _walk(child, f"{prefix}{name}.")
