"""Procedural ground as a background set."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from skyproof.errors import ConfigurationError
from skyproof.ground.ground import draw_ground_and_sun
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS


def write_procedural_backgrounds(
    folder: Path,
    counts: Mapping[str, int],
    size_px: int,
    *,
    seed: int,
    gsd_m: float = 0.125,
    progress: Callable[[int, int], None] | None = None,
) -> BackgroundSet:
    """Draws a background set, each tile with the sensor that photographed it.

    Args:
        folder: where to; use `finished_folder` around it where a half-written folder must not stay.
        counts: tiles per split.
        size_px: tiles are size_px x size_px.
        seed: decides every tile, each by a generator of its own, so that its bytes do not depend
            on how many others are drawn.
        gsd_m: metres per pixel.
        progress: called with (tiles done, tiles in all).

    Raises:
        ConfigurationError: a split of another name.
        RunFolderError: the disk cannot take it.
    """
    unknown = set(counts) - set(SPLITS)
    if unknown:
        raise ConfigurationError(
            f"Unknown split {sorted(unknown)[0]!r}; the splits are {', '.join(SPLITS)}."
        )
    total = sum(counts.values())
    tiles = []
    for split in SPLITS:
        for number in range(counts.get(split, 0)):
            state = np.random.SeedSequence(
                [seed % 2**64, SPLITS.index(split), number]
            ).generate_state(1, np.uint64)
            generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
            ground = draw_ground_and_sun(size_px, gsd_m, generator=generator)
            tile_id = f"{split}-{number:05d}"
            tile = BackgroundTile(
                id=tile_id,
                file=f"tiles/{tile_id}.png",
                split=split,
                width_px=size_px,
                height_px=size_px,
                source="procedural",
                kind=ground.kind,
                sensor=ground.sensor,
                light=ground.light,
                drivable=save_map(folder, "drivable", tile_id, ground.directions),
                shade=save_map(folder, "shade", tile_id, ground.shade),
                cover=save_map(folder, "cover", tile_id, ground.cover),
            )
            save_tile(folder, tile, ground.image)
            tiles.append(tile)
            if progress is not None:
                progress(len(tiles), total)
    write_index(folder, gsd_m, tiles)
    return BackgroundSet.open(folder)
