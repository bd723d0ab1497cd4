"""Limits of what a stranger's network may compute, measured before it takes memory or time."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from skyproof.errors import ConfigurationError

SIDE_PX = 256
"""Side of the image that a network is measured with."""

# Several times what the largest published networks of Ultralytics take (200 million numbers, the
# largest answer 6 million; 97 billion operations; 1,200 parts). In larger images, memory and time
# grow with the number of pixels.
_MOST_NUMBERS = 500_000_000
_MOST_AT_ONCE = 32_000_000
_MOST_OPERATIONS = 400_000_000_000
_MOST_PARTS = 10_000


@contextmanager
def measured() -> Iterator[None]:
    """Lets the block build and run networks without memory for their numbers; refuses large ones.

    It counts all weights and outputs, views included, and the operations of convolutions and
    matrix products.
    """
    parts = 0

    def count_part(*_: Any) -> None:
        nonlocal parts
        parts += 1
        _refuse_beyond(parts, _MOST_PARTS, "parts")

    hook = nn.modules.module.register_module_module_registration_hook(count_part)
    try:
        with torch.device("meta"), torch.no_grad(), Meter():
            yield
    finally:
        hook.remove()


class Meter(TorchDispatchMode):
    """Counts numbers and operations, and stops after the step that exceeds a limit."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers = 0
        self.operations = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        named = kwargs or {}
        answer = function(*args, **named)
        for part in tree_leaves(answer):
            # What is changed in place was counted before.
            if isinstance(part, Tensor) and not any(part is given for given in args):
                self.numbers += part.numel()
                _refuse_beyond(part.numel(), _MOST_AT_ONCE, "numbers at once")
        _refuse_beyond(self.numbers, _MOST_NUMBERS, "numbers")
        count = flop_registry.get(function.overloadpacket)
        if count is not None:
            self.operations += count(*args, **named, out_val=answer)
            _refuse_beyond(self.operations, _MOST_OPERATIONS, "operations")
        return answer


def _refuse_beyond(count: int, most: int, what: str) -> None:
    if count > most:
        raise ConfigurationError(
            f"the network would take more than {most:,} {what} for an image of {SIDE_PX} px; no "
            "detector needs so many."
        )
