"""The numbers that a network consists of: as plain tensors, and as one digest."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor, nn

__all__ = ["plain_state", "tensors_digest", "weights_digest"]


def weights_digest(detector: nn.Module) -> str:
    """Computes the SHA-256 over names, shapes and bytes of parameters and buffers.

    It is equal before and after an attack, which leaves the detector as it was.
    """
    return tensors_digest(detector.state_dict())


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """Computes the SHA-256 over names, shapes and bytes of tensors."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(
            tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        )
    return digest.hexdigest()


def plain_state(detector: nn.Module) -> dict[str, Tensor]:
    """Copies parameters and buffers to the CPU, in plain layout, as safetensors wants them."""
    return {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in detector.state_dict().items()
    }
