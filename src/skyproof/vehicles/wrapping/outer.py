"""Finds the outer surface of a mesh as points: what is seen from somewhere outside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from skyproof.vehicles.wrapping.views import parallel_view, view_axes

# Azimuth and elevation in degrees: above, four sides, six slanting views, four from near the
# ground, and below.
_VIEWS = (
    [(-90, 90)]
    + [(turn, 0) for turn in range(0, 360, 90)]
    + [(turn + 45, 40) for turn in range(0, 360, 90)]
    + [(turn + 45, 8) for turn in range(0, 360, 90)]
    + [(turn, 40) for turn in (0, 180)]
    + [(-90, -90)]
)
_BELOW = len(_VIEWS) - 1


@dataclass(frozen=True)
class Outer:
    """Points that are seen from outside.

    Attributes:
        normals: `[N, 3]` unit, of their triangle, towards the view.
        below: `[N]` whether only the view from straight below sees it.
        inverted, seen: number of triangles seen from their inside, and of all seen.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    face: Int[np.ndarray, " N"]
    weights: Float[np.ndarray, "N 3"]
    below: Bool[np.ndarray, " N"]
    inverted: int
    seen: int


def look_around(corners: Float[np.ndarray, "F 3 3"], *, pixel_m: float | None = None) -> Outer:
    """Looks at a mesh from 16 directions and keeps each pixel's point, whatever the winding.

    Args:
        pixel_m: distance of the rays; the default is 1.25 cm on a car, more on larger vehicles.
    """
    extent = np.ptp(corners.reshape(-1, 3), axis=0)
    pixel = pixel_m or max(0.0125, float(extent[0]) / 400)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-300)
    faces, weights, signs, below = [], [], [], []
    votes = np.zeros(len(corners), np.int64)
    for number, (azimuth, elevation) in enumerate(_VIEWS):
        axes = view_axes(np.radians(azimuth), np.radians(elevation))
        view = corners @ axes.T
        low = view.reshape(-1, 3).min(0)[:2]
        high = view.reshape(-1, 3).max(0)[:2]
        rows, columns = np.ceil((high - low) / pixel).astype(int)[::-1] + 1
        seen = parallel_view(view, low, pixel, (int(rows), int(columns)))
        hit = seen.face >= 0
        face = seen.face[hit]
        towards = normal[face] @ -axes[2]
        faces.append(face)
        weights.append(seen.weights[hit])
        signs.append(np.where(towards < 0, -1.0, 1.0))
        below.append(np.full(len(face), number == _BELOW))
        # Edge-on pixels say nothing about the side.
        np.add.at(
            votes, face, np.where(np.abs(towards) > 0.1, np.sign(towards), 0).astype(np.int64)
        )
    face = np.concatenate(faces)
    weight = np.concatenate(weights)
    points = np.einsum("nk,nkc->nc", weight, corners[face])
    normals = normal[face] * np.concatenate(signs)[:, None]
    return Outer(
        points,
        normals,
        face,
        weight,
        np.concatenate(below),
        int((votes < 0).sum()),
        int((votes != 0).sum()),
    )
