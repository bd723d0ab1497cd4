"""Parallel views of a mesh, whichever way its triangles are wound, and its outer surface."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from skyproof.geometry.rasterise import rasterise, visible_faces

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
_PIXEL_M = 0.0125


class SeenFaces(NamedTuple):
    """The visible triangle of each pixel (-1 without any) and its centre's barycentric weights."""

    face: Int[np.ndarray, "H W"]
    weights: Float[np.ndarray, "H W 3"]


def view_axes(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """Returns the directions right, down and away as seen from this azimuth and elevation."""
    azimuth_rad, elevation_rad = np.radians((azimuth_deg, elevation_deg))
    c = np.cos(azimuth_rad)
    s = np.sin(azimuth_rad)
    ce = np.cos(elevation_rad)
    se = np.sin(elevation_rad)
    return np.array([[-s, c, 0.0], [c * se, s * se, -ce], [-c * ce, -s * ce, -se]])


def parallel_view(
    corners: Float[np.ndarray, "F 3 3"],
    origin: Float[np.ndarray, " 2"],
    pixel: float,
    size: tuple[int, int],
) -> SeenFaces:
    """Finds the nearest triangle at every pixel's centre of a view; `size` is height and width."""
    height, width = size
    screen = torch.from_numpy((corners[..., :2] - origin) / pixel)
    depth = torch.from_numpy(np.ascontiguousarray(corners[..., 2]))
    faces = torch.arange(3 * len(corners)).view(-1, 3)
    places = (screen.view(1, -1, 2), depth.view(1, -1))
    seen = visible_faces(rasterise(*places, faces, max(height, width), two_sided=True))
    # The rasterised window is square; the part beyond the picture is cut off.
    face = seen[0, :height, :width]
    y, x = torch.nonzero(face >= 0, as_tuple=True)
    a, b, c = screen[face[y, x]].unbind(1)
    to_b, to_c, to_centre = b - a, c - a, torch.stack((x, y), dim=1).double() + 0.5 - a
    area = _cross(to_c, to_b)
    second, third = _cross(to_c, to_centre) / area, _cross(to_centre, to_b) / area
    weights = torch.zeros(height, width, 3, dtype=torch.float64)
    weights[y, x] = torch.stack((1 - second - third, second, third), dim=1)
    return SeenFaces(face.numpy(), weights.numpy())


def _cross(first: Float[torch.Tensor, "K 2"], second: Float[torch.Tensor, "K 2"]) -> torch.Tensor:
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


@dataclass(frozen=True)
class Outer:
    """Points seen from outside, and how many triangles are `seen`, of which some are `inverted`.

    Normals are those of the triangles, turned towards the view; `below` marks points of the view
    from below.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    face: Int[np.ndarray, " N"]
    weights: Float[np.ndarray, "N 3"]
    below: Bool[np.ndarray, " N"]
    inverted: int
    seen: int


def look_around(corners: Float[np.ndarray, "F 3 3"]) -> Outer:
    """Looks at a mesh from 16 directions and keeps each pixel's point, whatever the winding.

    Rays are 1.25 cm apart on a car, more on larger vehicles.
    """
    extent = np.ptp(corners.reshape(-1, 3), axis=0)
    pixel = max(_PIXEL_M, float(extent[0]) / 400)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-300)
    looks = []
    votes = np.zeros(len(corners), np.int64)
    for azimuth, elevation in _VIEWS:
        axes = view_axes(float(azimuth), float(elevation))
        view = corners @ axes.T
        low = view.reshape(-1, 3).min(0)[:2]
        high = view.reshape(-1, 3).max(0)[:2]
        columns, rows = (np.ceil((high - low) / pixel).astype(int) + 1).tolist()
        seen = parallel_view(view, low, pixel, (rows, columns))
        hit = seen.face >= 0
        face = seen.face[hit]
        towards = normal[face] @ -axes[2]
        normals = normal[face] * np.where(towards < 0, -1.0, 1.0)[:, None]
        looks.append((normals, face, seen.weights[hit], np.full(len(face), elevation == -90)))
        # Triangles seen edge-on do not tell which side is outside.
        side = np.where(np.abs(towards) > 0.1, np.sign(towards), 0).astype(np.int64)
        np.add.at(votes, face, side)
    normals, face, weights, below = (np.concatenate(parts) for parts in zip(*looks, strict=True))
    points = np.einsum("nk,nkc->nc", weights, corners[face])
    inverted, seen_faces = int((votes < 0).sum()), int((votes != 0).sum())
    return Outer(points, normals, face, weights, below, inverted, seen_faces)
