"""Splits by place: disjoint blocks, shares, none empty, determinism."""

import pytest
import torch

from skyproof.errors import ConfigurationError
from skyproof.imagery.settings import TilingSettings
from skyproof.imagery.tiles.blocks import assign_splits
from skyproof.imagery.tiles.grid import Cell
from skyproof.scenes.splits import SPLITS


def cells(rows, columns, grid="f"):
    """A grid of cells of 48 m."""
    return [
        Cell(
            f"{grid}-{row}-{column}",
            None,
            48.0 * column,
            -48.0 * row,
            384,
            0.125,
            (0,),
            block=(grid, row, column),
        )
        for row in range(rows)
        for column in range(columns)
    ]


USUAL = TilingSettings().split_shares


def divide(grid, seed=0, shares=USUAL):
    generator = torch.Generator().manual_seed(seed)
    return assign_splits(grid, shares, generator=generator)


def test_blocks_are_whole_and_shares_come_out():
    grid = cells(48, 64)
    splits, widths_m = divide(grid)
    assert widths_m == {"f": 384.0}
    for cell in grid:
        _, row, column = cell.block
        assert splits[cell.id] == splits[f"f-{row // 8 * 8}-{column // 8 * 8}"]
    for split in SPLITS:
        share = sum(one == split for one in splits.values()) / len(grid)
        assert abs(share - USUAL[split]) <= 64 / len(grid)


def test_neighbours_are_mostly_together():
    grid = cells(64, 64)
    splits, _ = divide(grid)
    together = [
        splits[f"f-{r}-{c}"] == splits[f"f-{r}-{c + 1}"] for r in range(64) for c in range(63)
    ]
    # Independent cells would agree in 35 % of the cases.
    assert sum(together) / len(together) > 0.85


def test_blocks_shrink_until_every_split_has_one():
    for count in (4, 7):
        splits, widths_m = divide(cells(1, count))
        assert {*splits.values()} == {*SPLITS}, count
        assert widths_m["f"] >= 48
    assert len({*divide(cells(1, 2))[0].values()}) == 2


def test_the_seed_alone_decides_and_frames_are_apart():
    grid = cells(12, 12, "a") + cells(12, 12, "b")
    assert divide(grid) == divide(grid)
    assert divide(grid)[0] != divide(grid, seed=1)[0]
    splits = divide(grid)[0]
    assert any(splits[f"a-{r}-{c}"] != splits[f"b-{r}-{c}"] for r in range(12) for c in range(12))


def test_a_split_without_a_share_gets_nothing():
    shares = TilingSettings(shares=(0.0, 0.25, 0.25, 0.5)).split_shares
    splits, _ = divide(cells(20, 20), shares=shares)
    counts = [sum(one == split for one in splits.values()) for split in SPLITS]
    # Blocks of 4 x 4 cells.
    assert counts[0] == 0
    assert counts[1:] == pytest.approx([100, 100, 200], abs=16)
    assert {*divide(cells(1, 3), shares=shares)[0].values()} == {*SPLITS[1:]}
    with pytest.raises(ConfigurationError, match=r"expect a sum of 1, got 0\.5 0\.5 0\.5 0"):
        TilingSettings(shares=(0.5, 0.5, 0.5, 0.0))
