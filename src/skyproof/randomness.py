"""A generator of its own for every purpose, from one seed of 64 bits, negative ones included."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    import numpy as np

__all__ = ["generator_of", "next_seed", "numpy_generator"]


def generator_of(seed: int, *names: str | int) -> torch.Generator:
    """Returns a generator for one purpose.

    So a change to one stage leaves the draws of the others alone.

    Args:
        seed: the run's.
        names: the purpose, such as "fleet" and the split.
    """
    mixed = seed
    for name in names:
        for byte in str(name).encode() + b"/":
            mixed = (mixed * 1_000_003 + byte) % (2**63 - 25)
    return torch.Generator().manual_seed(mixed)


def numpy_generator(seed: int) -> np.random.Generator:
    """Returns NumPy's generator for a seed; NumPy itself takes no negative ones."""
    import numpy as np

    return np.random.default_rng(seed % 2**64)


def next_seed(seed: int, number: int) -> int:
    """Returns the seed of the repeat of that number; after the largest of 64 bits comes the least.

    Args:
        seed: the run's.
        number: added to it.
    """
    return (seed + number + 2**63) % 2**64 - 2**63
