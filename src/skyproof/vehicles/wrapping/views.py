"""Parallel views of a mesh, whichever way its triangles are wound, for looking and measuring."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from skyproof.geometry.rasterise import barycentric, rasterise


class SeenFaces(NamedTuple):
    """The visible triangle of each pixel (-1 without any) and its centre's barycentric weights."""

    face: Int[np.ndarray, "H W"]
    weights: Float[np.ndarray, "H W 3"]


def view_axes(azimuth_rad: float, elevation_rad: float) -> Float[np.ndarray, "3 3"]:
    """Returns image right, image down and away from a viewer at this azimuth and elevation."""
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
    seen = rasterise(
        screen.view(1, -1, 2), depth.view(1, -1), faces, max(height, width), two_sided=True
    )
    # The window is square; what lies beyond the picture goes.
    held = (seen.x < width) & (seen.y < height)
    x, y, triangle = seen.x[held], seen.y[held], seen.face[held]
    centre = torch.stack((x, y)).double() + 0.5
    face = torch.full((height, width), -1)
    weights = torch.zeros(height, width, 3, dtype=torch.float64)
    face[y, x] = triangle
    weights[y, x] = barycentric(screen[triangle].permute(1, 2, 0), centre).t()
    return SeenFaces(face.numpy(), weights.numpy())
