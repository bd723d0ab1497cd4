"""Divides the cells of grids among the splits, in contiguous blocks."""

from collections import Counter
from collections.abc import Mapping, Sequence

import torch

from skyproof.imagery.tiles.grid import BlockKey, Cell
from skyproof.scenes.splits import Split

WANTED_BLOCKS = 24
WIDEST_BLOCK_M = 400.0


def assign_splits(
    cells: Sequence[Cell], shares: Mapping[Split, float], *, generator: torch.Generator
) -> tuple[dict[str, Split], dict[str, float]]:
    """Divides cells among the splits by their shares; returns the width of blocks by grid, too.

    A block of about 400 m goes to one split. Its width is halved until there are 24 blocks, so that
    the shares come out about right. Blocks are shuffled and sorted by size, the largest first. Each
    goes to a split that has none or, without such a split, to the one furthest behind its share.
    """
    width_m = WIDEST_BLOCK_M
    while True:
        sides = {cell.block[0]: max(1, round(width_m / cell.side_m)) for cell in cells}
        blocks = {cell.id: _block(cell, sides) for cell in cells}
        if len({*blocks.values()}) >= WANTED_BLOCKS or all(side == 1 for side in sides.values()):
            break
        width_m /= 2
    sizes = Counter(blocks.values())
    keys = list(sizes)
    order = torch.randperm(len(keys), generator=generator).tolist()
    given = dict.fromkeys(shares, 0)
    split_of: dict[BlockKey, Split] = {}
    for key in sorted((keys[i] for i in order), key=lambda key: -sizes[key]):
        split = min(shares, key=lambda name: (given[name] > 0, given[name] / shares[name]))
        split_of[key] = split
        given[split] += sizes[key]
    # Cells of one grid have one size.
    cell_of = {cell.block[0]: cell for cell in cells}
    widths_m = {grid: sides[grid] * one.side_m for grid, one in cell_of.items()}
    return {cell.id: split_of[blocks[cell.id]] for cell in cells}, widths_m


def _block(cell: Cell, sides: Mapping[str, int]) -> BlockKey:
    grid, row, column = cell.block
    return grid, row // sides[grid], column // sides[grid]
