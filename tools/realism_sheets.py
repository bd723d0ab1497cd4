"""The pictures of tools/realism.py; all of them show imagery and stay in the run's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from realism_crops import Crop
from realism_folds import SAME_SPOT_M, spots
from torch import Tensor

from skyproof.files import write_beside

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_COLUMNS = 14
_ENLARGED = 2
_GAP_PX = 3


def pairs(
    crops: Sequence[Crop], most: int, generator: np.random.Generator
) -> tuple[list[tuple[int, int]], int]:
    """Pairs real windows with rendered ones of the same spot, and the rest at random.

    Args:
        crops: the windows.
        most: how many pairs.
        generator: draws them.

    Returns:
        The indices of real and rendered windows, those of one spot first; and how many these are.
    """
    real = [index for index, crop in enumerate(crops) if not crop.rendered]
    free = [index for index, crop in enumerate(crops) if crop.rendered]
    real = [real[place] for place in generator.permutation(len(real))]
    matched = []
    alone = []
    for index in real:
        near = [(_distance_m(crops[index], crops[other]), other) for other in free]
        distance_m, other = min(near, default=(np.inf, -1))
        if distance_m <= SAME_SPOT_M:
            matched.append((index, other))
            free.remove(other)
        else:
            alone.append(index)
    rest = [free[place] for place in generator.permutation(len(free))]
    shown = [*matched, *zip(alone, rest, strict=False)][:most]
    return shown, min(len(matched), len(shown))


def _distance_m(first: Crop, second: Crop) -> float:
    if first.ground != second.ground:
        return float("inf")
    return float(np.hypot(*np.subtract(first.position_m, second.position_m)))


def write_pairs(path: Path, crops: Sequence[Crop], chosen: Sequence[tuple[int, int]]) -> None:
    """Writes a sheet with every real window above the rendered one of its pair."""
    rows = [chosen[start : start + _COLUMNS] for start in range(0, len(chosen), _COLUMNS)]
    lines = []
    for row in rows:
        lines += [[crops[real] for real, _ in row], [crops[other] for _, other in row]]
    _write_lines(path, [[crop.pixels for crop in line] for line in lines], every=2)


def write_told(path: Path, crops: Sequence[Crop], scores: NDArray[np.float64]) -> None:
    """Writes what is told best and worst, one window of each spot.

    From above: real windows that look most real and most rendered to the networks, rendered ones
    that look most rendered and most real.

    Args:
        path: of the picture.
        crops: the windows.
        scores: `[N]` mean logits; nan where a window was not tested.
    """
    spot_of = spots(crops)
    rendered = np.array([crop.rendered for crop in crops])
    lines = []
    for kind, sign in ((~rendered, 1), (~rendered, -1), (rendered, -1), (rendered, 1)):
        own = np.flatnonzero(kind & ~np.isnan(scores))
        ordered = own[np.argsort(sign * scores[own])]
        _, first = np.unique(spot_of[ordered], return_index=True)
        lines.append([crops[index].pixels for index in ordered[np.sort(first)][:_COLUMNS]])
    _write_lines(path, lines, every=2)


def _write_lines(path: Path, lines: Sequence[Sequence[Tensor]], every: int) -> None:
    """Writes lines of windows, enlarged, with a gap after so many lines."""
    size = lines[0][0].shape[1] * _ENLARGED
    width = _COLUMNS * (size + _GAP_PX)
    sheet = np.full((len(lines) * (size + _GAP_PX) * 9 // 8, width, 3), 255, dtype=np.uint8)
    y = 0
    for number, line in enumerate(lines, 1):
        for column, pixels in enumerate(line):
            picture = pixels.permute(1, 2, 0).repeat_interleave(_ENLARGED, 0)
            x = column * (size + _GAP_PX)
            sheet[y : y + size, x : x + size] = picture.repeat_interleave(_ENLARGED, 1).numpy()
        y += size + (_GAP_PX if number % every else 4 * _GAP_PX)
    with write_beside(path) as temporary:
        Image.fromarray(sheet[:y]).save(temporary, format="png")


def write_occlusion(
    path: Path,
    windows: dict[str, Tensor],
    falls: dict[str, NDArray[np.float64]],
) -> None:
    """Writes, per kind of window, their mean picture and what hiding its parts changes.

    Args:
        path: of the picture.
        windows: per kind `[n, 3, s, s]` sRGB bytes.
        falls: per kind `[m, m]` how much less sure of the truth the networks are, on average.
    """
    figure, axes = plt.subplots(2, len(windows), figsize=(4.2 * len(windows), 8), squeeze=False)
    for column, (kind, pictures) in enumerate(windows.items()):
        mean = pictures.to(torch.float64).mean(0).permute(1, 2, 0).numpy() / 255
        axes[0, column].imshow(mean)
        axes[0, column].set_title(f"{kind}, mean of {len(pictures)}")
        shown = axes[1, column].imshow(falls[kind], cmap="magma", vmin=min(0.0, falls[kind].min()))
        axes[1, column].set_title("mean fall of the logit of the truth")
        figure.colorbar(shown, ax=axes[1, column], fraction=0.046)
        for row in (0, 1):
            axes[row, column].set_axis_off()
    with write_beside(path) as temporary:
        figure.savefig(temporary, format="png", dpi=90)
    plt.close(figure)
