"""The device that a command works on."""

from typing import TYPE_CHECKING

from skyproof.errors import ConfigurationError

if TYPE_CHECKING:
    import torch


def choose_device(name: str) -> "torch.device":
    """Returns the device of that name; "auto" takes a CUDA device where there is one."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        # Read back: torch also knows devices without memory.
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        raise ConfigurationError(
            f"--device {name} is not usable here; give cpu, cuda or auto."
        ) from error
    return device
