"""Which triangle a parallel view sees at each pixel: a plain z-buffer for looking and measuring."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

__all__ = ["View", "view_axes", "z_buffer"]

_CHUNK = 4_000_000


class View:
    """What each pixel sees.

    Attributes:
        face: `[H, W]` triangle, -1 where nothing is.
        weights: `[H, W, 3]` barycentric.
    """

    def __init__(self, face: Int[np.ndarray, "H W"], weights: Float[np.ndarray, "H W 3"]) -> None:
        self.face, self.weights = face, weights


def view_axes(azimuth_rad: float, elevation_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rows: image right, image down, and away from the viewer, who stands at this azimuth and elevation."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    ce, se = np.cos(elevation_rad), np.sin(elevation_rad)
    return np.array([[-s, c, 0.0], [c * se, s * se, -ce], [-c * ce, -s * ce, -se]])


def z_buffer(
    corners: Float[np.ndarray, "F 3 3"], origin: Float[np.ndarray, " 2"], pixel: float, size: tuple[int, int]
) -> View:
    """Finds the nearest triangle at every pixel's centre, whichever way it faces.

    Args:
        corners: in the view's axes: right, down, away.
        origin: right and down of the picture's top-left corner.
        pixel: side of a pixel in the unit of `corners`.
        size: height and width in pixels.
    """
    height, width = size
    place = (corners[..., :2] - origin) / pixel - 0.5
    low = np.ceil(place.min(1)).astype(np.int64).clip(0)
    high = np.floor(place.max(1)).astype(np.int64)
    high = np.minimum(high, [width - 1, height - 1])
    counts = (high - low + 1).clip(0).prod(1)
    a, b, c = place.transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    counts[np.abs(area) < 1e-12] = 0
    best = np.full(height * width, np.inf)
    face = np.full(height * width, -1, np.int64)
    weights = np.zeros((height * width, 3))
    for group in _groups(counts):
        index = np.repeat(group, counts[group])
        step = np.arange(len(index)) - np.repeat(counts[group].cumsum() - counts[group], counts[group])
        columns = high[index, 0] - low[index, 0] + 1
        x, y = low[index, 0] + step % columns, low[index, 1] + step // columns
        p = np.stack([x, y], axis=1)
        second = _cross(c[index] - a[index], p - a[index]) / -area[index]
        third = _cross(b[index] - a[index], p - a[index]) / area[index]
        bary = np.stack([1 - second - third, second, third], axis=1)
        inside = bary.min(1) >= -1e-9
        index, bary, at = index[inside], bary[inside], (y * width + x)[inside]
        depth = (bary * corners[index, :, 2]).sum(1)
        order = np.lexsort((depth, at))
        at, depth, index, bary = at[order], depth[order], index[order], bary[order]
        first = np.r_[True, at[1:] != at[:-1]] if len(at) else np.zeros(0, bool)
        at, depth, index, bary = at[first], depth[first], index[first], bary[first]
        nearer = depth < best[at]
        best[at[nearer]], face[at[nearer]], weights[at[nearer]] = depth[nearer], index[nearer], bary[nearer]
    return View(face.reshape(size), weights.reshape(*size, 3))


def _groups(counts: Int[np.ndarray, " F"]) -> list[np.ndarray]:
    """Triangles in groups of bounded work."""
    some = np.flatnonzero(counts)
    part = counts[some].cumsum() // _CHUNK
    return [some[part == value] for value in np.unique(part)]


def _cross(a: Float[np.ndarray, "N 2"], b: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
