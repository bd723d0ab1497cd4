"""Counts where in the RGB cube the colours of pictures lie: published patches beside our textures.

    python tools/pattern_colours.py FOLDER...

Each folder is one row of a Markdown table: the mean over the pictures in it and below it, every
pixel counting alike. Shares are those of `skyproof.reproduction.count_colours`; beside a
reproduction's table of colours they say whether others' patterns end where its textures do.
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import fmean

import torch

from skyproof.pictures import read_pixels
from skyproof.reproduction.count_colours import ColourCounts, count_colours

ENDINGS = (".jpg", ".jpeg", ".png")


def count_folder(folder: Path) -> list[ColourCounts]:
    """Counts every picture of a folder."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS)
    pictures = (read_pixels(path, "replace it, or take it away") for path in paths)
    return [count_colours(torch.from_numpy(pixels).permute(2, 0, 1)) for pixels in pictures]


def main() -> None:
    """Prints the table."""
    print("| pictures | number | faces, % | edges, % | corners, % |")
    print("| -- | -- | -- | -- | -- |")
    for folder in map(Path, sys.argv[1:]):
        counts = count_folder(folder)
        if not counts:
            raise SystemExit(f"expected pictures ({', '.join(ENDINGS)}) in {folder}, found none")
        shares = [
            fmean(getattr(each, place) for each in counts)
            for place in ("faces", "edges", "corners")
        ]
        cells = " | ".join(f"{100 * share:.1f}" for share in shares)
        print(f"| {folder.name} | {len(counts)} | {cells} |")


if __name__ == "__main__":
    main()
