"""Tensors in files: safetensors with a record beside the numbers, and no pickle."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from skyproof.documents import parse_document
from skyproof.errors import NotFiniteError, StoredFileError
from skyproof.files import refuse_special, to_json, write_bytes


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], record: Mapping[str, Any] | None = None
) -> None:
    """Writes tensors, and a JSON record if there is one, to one file, whole or not at all.

    No two tensors may share memory, and every number must be finite. A kill can never leave record
    or tensors older than the other.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    broken = _not_finite(plain)
    if broken is not None:
        raise NotFiniteError(
            f"{path} would hold numbers that are not finite ({broken}) and was not written; lower "
            "the learning rate."
        )
    metadata = None if record is None else {"record": to_json(path, record)}
    write_bytes(Path(path), save(plain, metadata=metadata))


def read_tensors(path: Path, remedy: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Reads a file of `write_tensors` to the CPU, with its record or an empty one; runs no code."""
    refuse_special(path, remedy)
    if not Path(path).is_file():
        raise StoredFileError(f"{path} is missing; {remedy}.")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("record", "{}")
            # Tensors lie at any address in the file, which changes the order of sums in kernels. A
            # copy gives the same numbers as the written tensors, to the last bit.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        broken = _not_finite(tensors)
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        # Torch cannot use every type that safetensors knows.
        reason = getattr(error, "strerror", None) or "it is no whole safetensors file"
        raise StoredFileError(f"{path} is damaged ({reason}); {remedy}.") from error
    record: dict[str, Any] = parse_document(
        text.encode(), dict[str, Any], f"{path} has a record that", remedy
    )
    if broken is not None:
        raise StoredFileError(f"{path} holds numbers that are not finite ({broken}); {remedy}.")
    return tensors, record


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """Computes the SHA-256 over names, shapes and bytes of tensors."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def weights_digest(network: nn.Module) -> str:
    """Computes the SHA-256 over names, shapes and bytes of parameters and buffers."""
    return tensors_digest(network.state_dict())


def _not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Names the first tensor that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point():
            # Torch can do little with kinds below 16 bits but widen them.
            wide = tensor.float() if tensor.element_size() == 1 else tensor
            if not torch.isfinite(wide).all():
                return name
    return None
