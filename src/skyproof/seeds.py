"""Seeds of 64 bits, negative ones included, without torch; see also `skyproof.randomness`."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def numpy_generator(seed: int) -> "np.random.Generator":
    """Returns NumPy's generator for a seed, negative ones included, which NumPy does not accept."""
    import numpy as np

    return np.random.default_rng(seed % 2**64)


def next_seed(seed: int, number: int) -> int:
    """Returns `seed` plus `number`; the smallest 64-bit number follows the largest."""
    return (seed + number + 2**63) % 2**64 - 2**63
