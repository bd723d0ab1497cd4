"""The numbers of a network, as plain tensors and as one digest."""

from torch import Tensor, nn

from skyproof.storage import tensors_digest


def weights_digest(detector: nn.Module) -> str:
    """Computes the SHA-256 over names, shapes and bytes of parameters and buffers."""
    return tensors_digest(detector.state_dict())


def plain_state(detector: nn.Module) -> dict[str, Tensor]:
    """Copies parameters and buffers to the CPU, in the plain layout that safetensors needs."""
    return {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in detector.state_dict().items()
    }
