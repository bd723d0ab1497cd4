"""Times `tile_imagery` on mosaics that it makes itself, and takes its peak memory.

    python tools/bench_tiling.py FOLDER

One mosaic is 100,000 x 100,000 px (30 GB unpacked) but sparse: a few stretches hold data, so that
it fits on any disk. The others are 4,096 x 4,096 px and full. Every one is tiled by a process of
its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rasterio
import torch
from rasterio.transform import from_origin
from rasterio.windows import Window

from skyproof.imagery.settings import TilingSettings
from skyproof.imagery.tiles.tiling import tile_imagery

BLOCK_PX = 4096
# Name: side in px, stretches that hold data, metres per pixel, reference system, tiled inside, tile
# side.
MOSAICS = {
    "30 GB, sparse": (100_000, 6, 0.125, "EPSG:2193", True, 384),
    "30 GB, sparse, finer": (100_000, 12, 0.05, "EPSG:2193", True, 384),
    "same grid": (4_096, 1, 0.125, "EPSG:2193", True, 384),
    "finer (5 cm), averaged": (4_096, 1, 0.05, "EPSG:2193", True, 384),
    "Web Mercator, warped": (4_096, 1, 0.17, "EPSG:3857", True, 384),
    "same grid, strips": (4_096, 1, 0.125, "EPSG:2193", False, 384),
    "finer, tiles of 2,048 px": (4_096, 1, 0.07, "EPSG:2193", True, 2048),
}


def make(path: Path, side_px: int, blocks: int, gsd_m: float, crs: str, tiled: bool) -> None:
    """A mosaic with patchy stretches of data; all else is nodata and takes no room."""
    place = (1_550_016.0, 5_190_000.0) if crs == "EPSG:2193" else (19_200_000.0, -5_390_000.0)
    layout = {"tiled": True, "blockxsize": 512, "blockysize": 512} if tiled else {}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=side_px,
        height=side_px,
        count=3,
        dtype="uint8",
        crs=crs,
        nodata=0,
        transform=from_origin(*place, gsd_m, gsd_m),
        sparse_ok=True,
        bigtiff="YES",
        compress="deflate",
        photometric="RGB",
        interleave="pixel",
        zlevel=1,
        **layout,
    ) as dataset:
        coarse = np.random.default_rng(0).integers(
            60, 200, (3, BLOCK_PX // 8, BLOCK_PX // 8), dtype=np.uint8
        )
        stretch = coarse.repeat(8, 1).repeat(8, 2)
        across = side_px // BLOCK_PX
        for number in range(blocks):
            scattered = (number * 5 % across, number * 7 % across)
            column, row = scattered
            dataset.write(
                stretch, window=Window(column * BLOCK_PX, row * BLOCK_PX, BLOCK_PX, BLOCK_PX)
            )


def peak_mb() -> float:
    """The most memory this process ever held (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def measure(path: Path, size_px: int) -> None:
    """Tiles one mosaic and prints a row."""
    torch.set_num_threads(1)
    before_mb, cpu, wall = peak_mb(), time.process_time(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        record = tile_imagery(
            [path],
            Path(folder),
            settings=TilingSettings(size_px=size_px),
            generator=torch.Generator().manual_seed(0),
        )
    cpu, wall = time.process_time() - cpu, time.monotonic() - wall
    tiles = sum(count["tiles"] for count in record.counts.values())
    print(
        f"{tiles:>5} tiles, {record.empty:>6} empty cells, {wall:6.1f} s, {cpu:6.1f} CPU s, "
        f"{tiles / cpu:5.1f} tiles per CPU s, peak {peak_mb():4.0f} MB ({before_mb:.0f} MB before)",
        flush=True,
    )


def main() -> None:
    """Makes every mosaic in the folder given and measures it."""
    if len(sys.argv) == 3:
        measure(Path(sys.argv[1]), int(sys.argv[2]))
        return
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, (side_px, blocks, gsd_m, crs, tiled, size_px) in MOSAICS.items():
        path = folder / "mosaic.tif"
        make(path, side_px, blocks, gsd_m, crs, tiled)
        print(f"{name:<26}", end="", flush=True)
        subprocess.run([sys.executable, __file__, str(path), str(size_px)], check=True)
        path.unlink()


if __name__ == "__main__":
    main()
