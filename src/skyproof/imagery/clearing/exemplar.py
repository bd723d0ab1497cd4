"""Fills holes with ground from nearby: patches are copied and joined without a seam."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from scipy import fft, ndimage, sparse
from scipy.sparse.linalg import splu
from torch import Tensor

from skyproof.datasets.pictures import Pixels

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Shift = tuple[int, int]
Spectrum = NDArray[np.complex64]

# Lengths suit ground of 10 to 15 cm per pixel.
_SEARCH_PX = 112
"""Largest distance of the copied ground, in rows and in columns."""
_RING_PX = 7
"""Width of the known ring around a hole, which the copied ground's ring must resemble."""
_PIECE_PX = 72
"""Larger holes are filled piece by piece, each about this wide and copied from one place."""
_POOR = 0.012
"""Cost of a copy (mean squared difference of values from 0 to 1) above which a piece is halved."""
_LEAST_PX = 24
"""Pieces up to this wide and high are not halved."""
_PLAINNESS = 0.15
"""Weight of the copied ground's contrast against the ring's mismatch: plain ground is preferred."""
_HOLD = 0.02
"""Weight of the copied ground's values, levelled as a whole, against a joint without a step."""
_BRIGHTNESS_FREEDOM = 0.7
"""Share of an even difference in brightness that is no mismatch, because it is levelled."""
_SEEN_SHARE = 0.6
"""Smallest share of a shifted ring on ground that may be compared."""


@dataclass(frozen=True)
class _Window:
    """A part of the picture around one piece.

    Attributes:
        values: `[H, W, 3]`.
        known: where the values are known.
        hole: where they are to be filled.
        sound: ground that may be copied.
    """

    values: Array
    known: Flags
    hole: Flags
    sound: Flags

    @cached_property
    def ring(self) -> Flags:
        """The known pixels around the hole."""
        return ndimage.binary_dilation(self.hole, iterations=_RING_PX) & ~self.hole & self.known


def fill_ground(image: Pixels, mask: Bool[Tensor, "H W"]) -> Pixels:
    """Fills the mask as `fill_by_exemplar` does; every byte outside it stays."""
    pixels = (image.float() / 255).permute(1, 2, 0).double().numpy()
    filled = torch.from_numpy(fill_by_exemplar(pixels, mask.numpy())).permute(2, 0, 1).float()
    return torch.where(mask, (filled.clamp(0, 1) * 255).round().to(torch.uint8), image)


def fill_by_exemplar(image: Array, mask: Flags) -> Array:
    """Returns `[H, W, 3]` with `mask` filled with ground of the same picture, unchanged elsewhere.

    The known ring around a piece of a hole is compared with the same ring at all shifts within a
    reach, and the piece is copied from the best one. Where even that one resembles it poorly, the
    piece is halved: large pieces keep lines whole, small ones find ground that fits. Without any
    shift, the colours of the hole's edge go on into it smoothly.
    """
    filled = image.copy()
    unknown = mask.copy()
    smooth = None
    left = _pieces(mask, _PIECE_PX)
    while left:
        # Small ones come first: once filled, they belong to the large ones' rings, but are never
        # copied. Halves are smaller than all that are left.
        piece = left.pop()
        place = _around(piece, _SEARCH_PX + _RING_PX + 1)
        window = _Window(filled[place], ~unknown[place], piece[place], ~mask[place])
        cost, shift = _best_shift(window)
        side_px = max(side.stop - side.start for side in _around(window.hole, 0))
        if cost > _POOR and side_px > _LEAST_PX:
            left += _pieces(piece, math.ceil(side_px / 2))
            continue
        if math.isfinite(cost):
            filled[place] = _copy(window, shift)
        else:
            smooth = _smooth(image, mask) if smooth is None else smooth
            filled[piece] = smooth[piece]
        unknown &= ~piece
    return filled


def _smooth(image: Array, mask: Flags) -> Array:
    """Fills the mask by Laplace's equation, or with the mean colour without a known edge."""
    even = np.broadcast_to(image[~mask].mean(axis=0), image.shape)
    return _join(_Window(image, ~mask, mask, ~mask), even, hold=1e-6)


def _pieces(mask: Flags, longest_px: int) -> list[Flags]:
    """Divides the connected holes, long ones into about square pieces; the largest come first."""
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    pieces = []
    for number, found in enumerate(ndimage.find_objects(labels), start=1):
        cuts = []
        for side in found:
            length = side.stop - side.start
            count = math.ceil(length / longest_px)
            cuts.append([side.start + length * each // count for each in range(count + 1)])
        for (top, bottom), (left, right) in itertools.product(*map(itertools.pairwise, cuts)):
            part = np.zeros_like(mask)
            part[top:bottom, left:right] = labels[top:bottom, left:right] == number
            if part.any():
                pieces.append(part)
    return sorted(pieces, key=lambda piece: -int(piece.sum()))


def _around(flags: Flags, margin_px: int) -> tuple[slice, slice]:
    """Returns the rows and columns of what is set, with a margin."""
    rows, columns = (
        slice(max(0, found.start - margin_px), found.stop + margin_px)
        for found in ndimage.find_objects(flags.astype(np.int8))[0]
    )
    return rows, columns


def _copy(window: _Window, shift: Shift) -> Array:
    """Fills the hole with the ground a shift away, levelled to fit the ring."""
    back = (-shift[0], -shift[1])
    seen = window.ring & np.roll(window.sound, back, (0, 1))
    copy = np.roll(window.values, back, (0, 1))
    return _join(window, copy + np.median((window.values - copy)[seen], axis=0), _HOLD)


def _best_shift(window: _Window) -> tuple[float, Shift]:
    """Finds the shift (down, across) at which the ring looks most alike.

    Its cost is infinite where no shift copies sound ground alone.
    """
    ring, sound = window.ring, window.sound
    if not ring.any():
        return math.inf, (0, 0)
    # Room for the largest shift, so that none wraps around.
    size = tuple(fft.next_fast_len(side + _SEARCH_PX, real=True) for side in ring.shape)

    def spectrum(values: NDArray[Any]) -> Spectrum:
        return fft.rfft2(values.astype(np.float32), size)

    def correlate(template: Spectrum, field: Spectrum) -> NDArray[np.float32]:
        return fft.irfft2(np.conj(template) * field, size)

    # Shifts that copy from sound ground alone, and the visible part of the ring.
    ground, ring_spectrum, hole_spectrum = map(spectrum, (sound, ring, window.hole))
    copied = ndimage.binary_dilation(window.hole)
    seen = correlate(ring_spectrum, ground).round()
    valid = (correlate(spectrum(copied), ground).round() == copied.sum()) & (
        seen >= _SEEN_SHARE * ring.sum()
    )
    seen = np.maximum(seen, 1)
    # The mismatch of the shifted ring, and the contrast of the copied ground.
    mismatch, contrast = np.zeros((2, *size), np.float32)
    for channel in np.moveaxis(window.values, 2, 0):
        # Around the ring's mean the sums of squares stay small and exact.
        values = np.where(sound | ring, channel - channel[ring].mean(), 0.0)
        sound_values = np.where(sound, values, 0.0)
        ring_values = np.where(ring, values, 0.0)
        field = spectrum(sound_values)
        squares = spectrum(sound_values**2)
        ring_field = spectrum(ring_values)
        # Sums over the part of the shifted ring that lies on sound ground.
        squared = (
            correlate(spectrum(ring_values**2), ground)
            + correlate(ring_spectrum, squares)
            - 2 * correlate(ring_field, field)
        )
        even = correlate(ring_field, ground) - correlate(ring_spectrum, field)
        mismatch += squared / seen - _BRIGHTNESS_FREEDOM * (even / seen) ** 2
        inside = correlate(hole_spectrum, field) / window.hole.sum()
        contrast += correlate(hole_spectrum, squares) / window.hole.sum() - inside**2
    cost = np.where(valid, np.maximum(mismatch, 0) + _PLAINNESS * np.maximum(contrast, 0), np.inf)
    # Rows and columns are shifts in the order of a Fourier transform.
    down, across = (fft.fftfreq(side, 1 / side).round().astype(int) for side in size)
    cost[abs(down) > _SEARCH_PX] = np.inf
    cost[:, abs(across) > _SEARCH_PX] = np.inf
    row, column = np.unravel_index(cost.argmin(), size)
    return float(cost[row, column]), (int(down[row]), int(across[column]))


def _join(window: _Window, copy: Array, hold: float) -> Array:
    """Solves a screened Poisson equation in the hole.

    Neighbours differ as in `copy` `[H, W, 3]`; `hold` is the weight of its own values.
    """
    # The numbered pixels of the hole are the unknowns.
    rows, columns = np.nonzero(window.hole)
    number = np.full(window.hole.shape, -1)
    number[rows, columns] = np.arange(len(rows))
    count = np.zeros(len(rows))
    right = np.zeros((len(rows), 3))
    links: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    # Every pixel should differ from its four neighbours as the copy does.
    for down, across in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        to_row = (rows + down).clip(0, window.hole.shape[0] - 1)
        to_column = (columns + across).clip(0, window.hole.shape[1] - 1)
        inside = (to_row == rows + down) & (to_column == columns + across)
        in_hole, fixed = window.hole[to_row, to_column], window.known[to_row, to_column]
        # There is no condition at the picture's edge and at pieces still to be filled.
        asked = inside & (in_hole | fixed)
        step = copy[rows, columns] - copy[to_row, to_column]
        count += asked
        right += np.where(asked[:, None], step, 0.0)
        on_ring = asked & ~in_hole
        right[on_ring] += window.values[to_row[on_ring], to_column[on_ring]]
        linked = np.nonzero(asked & in_hole)[0]
        links.append((linked, number[to_row[linked], to_column[linked]]))
    start, end = (np.concatenate([link[side] for link in links]) for side in (0, 1))
    matrix = sparse.csc_array((-np.ones(len(start)), (start, end)), shape=(len(rows), len(rows)))
    matrix = matrix + sparse.diags_array(count + hold)
    solved = splu(matrix.tocsc()).solve(right + hold * copy[rows, columns])
    filled = window.values.copy()
    filled[rows, columns] = solved
    return filled
