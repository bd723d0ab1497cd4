"""Divides tiles among the splits by place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import torch

from skyproof.imagery.tiles.grid import Cell
from skyproof.scenes.splits import Split

WANTED_BLOCKS = 24
DEFAULT_BLOCK_M = 400.0

BlockKey = tuple[str, int, int]


def assign_splits(
    cells: Sequence[Cell],
    shares: Mapping[Split, float],
    *,
    block_m: float | None,
    generator: torch.Generator,
) -> tuple[dict[str, Split], dict[str, float]]:
    """Divides cells among the splits by their shares, in square blocks of neighbours.

    The grid is cut into blocks of k x k cells, k so that a block is about `block_m` wide. A block
    goes to one split, so splits meet only where blocks do. Blocks are shuffled, put in order of
    their size, the largest first, and handed out one by one: first one to each split that has none,
    then to the split that is furthest behind its share of the cells. So every split gets something
    where there are as many blocks.

    k is halved until there are enough blocks: 24 where `block_m` is not given (400 m at first), so
    that the shares come out about right; one per split where it is given. Blocks of one cell are
    not divided.

    Args:
        cells: with their `block` set to (grid, row, column).
        shares: of the cells, above 0, of each split that gets any.

    Returns:
        Per cell id its split, and per grid the width of its blocks in metres.
    """
    wanted = WANTED_BLOCKS if block_m is None else len(shares)
    width_m = DEFAULT_BLOCK_M if block_m is None else block_m
    while True:
        sides = {cell.block[0]: _side(cell, width_m) for cell in cells if cell.block is not None}
        blocks = {cell.id: _block(cell, sides) for cell in cells}
        if len({*blocks.values()}) >= wanted or all(side == 1 for side in sides.values()):
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
    widths_m = {
        cell.block[0]: sides[cell.block[0]] * cell.size_px * cell.gsd_m
        for cell in cells
        if cell.block
    }
    return {cell.id: split_of[blocks[cell.id]] for cell in cells}, widths_m


def _side(cell: Cell, width_m: float) -> int:
    return max(1, round(width_m / (cell.size_px * cell.gsd_m)))


def _block(cell: Cell, sides: Mapping[str, int]) -> BlockKey:
    assert cell.block is not None
    grid, row, column = cell.block
    return grid, row // sides[grid], column // sides[grid]
