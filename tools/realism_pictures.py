"""The pictures of tools/realism.py; all of them show imagery and stay in the run's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from realism_pairs import ROOM_M, Pairs

from skyproof.files import write_beside

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_COLUMNS = 14
_ENLARGED = 2
_GAP_PX = 4


def write_sheet(path: Path, pairs: Pairs, chosen: Sequence[int]) -> None:
    """Writes pairs side by side, of each the real window above and the rendered one below.

    Args:
        path: of the picture.
        pairs: all windows.
        chosen: which of them, in the order of reading.
    """
    size = pairs.pixels.shape[-1] * _ENLARGED
    lines = -(-len(chosen) // _COLUMNS)
    height = 2 * size + 3 * _GAP_PX
    sheet = np.full((lines * height, _COLUMNS * (size + _GAP_PX), 3), 255, dtype=np.uint8)
    for number, index in enumerate(chosen):
        row, column = divmod(number, _COLUMNS)
        x = column * (size + _GAP_PX)
        for side in (0, 1):
            picture = pairs.pixels[index, side].permute(1, 2, 0).numpy()
            y = row * height + side * (size + _GAP_PX // 2)
            sheet[y : y + size, x : x + size] = picture.repeat(_ENLARGED, 0).repeat(_ENLARGED, 1)
    with write_beside(path) as temporary:
        Image.fromarray(sheet).save(temporary, format="png")


def write_occlusion(
    path: Path, pairs: Pairs, chosen: Sequence[int], falls: NDArray[np.float64], shown: int
) -> None:
    """Writes what hiding parts of windows takes from the truth: in the mean, and of the first ones.

    Args:
        path: of the picture.
        pairs: all windows.
        chosen: `n` of them.
        falls: `[n, 2, m, m]` of these, from `occlusion`.
        shown: how many single pairs are drawn beside the mean.
    """
    room = round(ROOM_M / pairs.gsd_m)
    inner = slice(room, pairs.pixels.shape[-1] - room)
    pictures = pairs.pixels[list(chosen)][..., inner, inner].permute(0, 1, 3, 4, 2).numpy() / 255
    columns = [(pictures.mean(0), falls.mean(0), f"mean of {len(chosen)}")]
    columns += [(pictures[n], falls[n], f"pair {chosen[n]}") for n in range(shown)]
    figure, axes = plt.subplots(4, len(columns), figsize=(1.9 * len(columns), 8), squeeze=False)
    for column, (both, maps, title) in enumerate(columns):
        limit = float(np.abs(maps).max()) or 1.0
        for side, kind in enumerate(("real", "rendered")):
            axes[2 * side, column].imshow(both[side])
            axes[2 * side, column].set_title(f"{kind}, {title}", fontsize=7)
            axes[2 * side + 1, column].imshow(maps[side], cmap="RdBu_r", vmin=-limit, vmax=limit)
            axes[2 * side + 1, column].set_title(f"red: tells; ±{limit:.2g}", fontsize=7)
    for own in axes.flat:
        own.set_axis_off()
    figure.tight_layout()
    with write_beside(path) as temporary:
        figure.savefig(temporary, format="png", dpi=90)
    plt.close(figure)
