"""A separate generator for every purpose, from one seed of 64 bits, negative ones included."""

import torch


def generator_of(seed: int, *names: str | int) -> torch.Generator:
    """Returns a generator for one purpose, such as "fleet" and a split; no draws are shared."""
    mixed = seed
    for name in names:
        for byte in str(name).encode() + b"/":
            mixed = (mixed * 1_000_003 + byte) % (2**63 - 25)
    return torch.Generator().manual_seed(mixed)
