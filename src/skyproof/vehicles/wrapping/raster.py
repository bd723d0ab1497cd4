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
    corners: Float[np.ndarray, "F 3 3"],
    origin: Float[np.ndarray, " 2"],
    pixel: float,
    size: tuple[int, int],
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
    # Second and third barycentric weight and depth of each triangle as planes: per x, per y, constant.
    safe = np.where(np.abs(area) < 1e-12, 1.0, area)[:, None]
    to_b, to_c = b - a, c - a
    second = np.stack([to_c[:, 1], -to_c[:, 0], _cross(to_c, a)], axis=1) / safe
    third = np.stack([-to_b[:, 1], to_b[:, 0], _cross(a, to_b)], axis=1) / safe
    rise = corners[:, 1:, 2] - corners[:, :1, 2]
    depth = second * rise[:, :1] + third * rise[:, 1:]
    depth[:, 2] += corners[:, 0, 2]

    best = np.full(height * width, np.inf)
    face = np.full(height * width, -1, np.int64)
    for group in _groups(counts):
        index = np.repeat(group, counts[group])
        step = np.arange(len(index)) - np.repeat(
            counts[group].cumsum() - counts[group], counts[group]
        )
        columns = high[index, 0] - low[index, 0] + 1
        down = step // columns
        x, y = low[index, 0] + step - down * columns, low[index, 1] + down
        two, three = _plane(second, index, x, y), _plane(third, index, x, y)
        inside = (two >= -1e-9) & (three >= -1e-9) & (two + three <= 1 + 1e-9)
        index, x, y = index[inside], x[inside], y[inside]
        at, near = y * width + x, _plane(depth, index, x, y)
        np.minimum.at(best, at, near)
        first = near == best[at]
        face[at[first]] = index[first]
    weights = np.zeros((height * width, 3))
    hit = np.flatnonzero(face >= 0)
    y, x = np.divmod(hit, width)
    weights[hit, 1], weights[hit, 2] = (
        _plane(second, face[hit], x, y),
        _plane(third, face[hit], x, y),
    )
    weights[hit, 0] = 1 - weights[hit, 1] - weights[hit, 2]
    return View(face.reshape(size), weights.reshape(*size, 3))


def _plane(
    planes: Float[np.ndarray, "F 3"],
    index: Int[np.ndarray, " N"],
    x: Int[np.ndarray, " N"],
    y: Int[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    return planes[index, 0] * x + planes[index, 1] * y + planes[index, 2]


def _groups(counts: Int[np.ndarray, " F"]) -> list[np.ndarray]:
    """Triangles in groups of bounded work."""
    some = np.flatnonzero(counts)
    part = counts[some].cumsum() // _CHUNK
    return [some[part == value] for value in np.unique(part)]


def _cross(a: Float[np.ndarray, "N 2"], b: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
