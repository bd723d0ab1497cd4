"""Measures how well a wrapped vehicle fits its mesh: outlines, distances, self-crossings."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from skyproof.geometry.intersections import self_intersections
from skyproof.vehicles.template import make_template
from skyproof.vehicles.wrapping.outer import Outer, look_around
from skyproof.vehicles.wrapping.surface import Wrapping
from skyproof.vehicles.wrapping.views import parallel_view, view_axes

_PIXEL_M = 0.01
_EVERY = 5  # points are dense enough for one in five


def outline_iou(
    first: Float[np.ndarray, "F 3 3"],
    second: Float[np.ndarray, "G 3 3"],
    *,
    azimuth_deg: float,
    elevation_deg: float,
) -> float:
    """Returns the intersection over union of two meshes' outlines at 1 cm per pixel."""
    axes = view_axes(np.radians(azimuth_deg), np.radians(elevation_deg))
    views = [corners @ axes.T for corners in (first, second)]
    points = np.concatenate([view.reshape(-1, 3) for view in views])[:, :2]
    low = points.min(0) - _PIXEL_M
    high = points.max(0) + _PIXEL_M
    columns, rows = np.ceil((high - low) / _PIXEL_M).astype(int)
    first_outline, second_outline = (
        parallel_view(view, low, _PIXEL_M, (int(rows), int(columns))).face >= 0 for view in views
    )
    return float((first_outline & second_outline).sum() / (first_outline | second_outline).sum())


def measure_wrapping(
    corners: Float[np.ndarray, "F 3 3"], outer: Outer, wrapping: Wrapping
) -> dict[str, float | int]:
    """Compares the wrapped template with the mesh.

    Distances run from points about 3 cm apart on each outer surface, as seen from the sides and
    from above, to the other's surface.

    Returns:
        iou_above, iou_side, iou_front: of outlines with mirrors; hausdorff_m: the largest distance
        either way; median_m, p95_m: from mesh to vehicle; crossings: pairs of crossing triangles.
    """
    template = make_template()
    wrapped = wrapping.vertices.double().numpy()[template.faces.numpy()]
    skin = look_around(wrapped)
    clouds = [(cloud.points[~cloud.below], cloud.normals[~cloud.below]) for cloud in (outer, skin)]
    to_mesh = _distances(*clouds)
    to_template = _distances(*clouds[::-1])
    return {
        "iou_above": round(outline_iou(corners, wrapped, azimuth_deg=-90.0, elevation_deg=90.0), 4),
        "iou_side": round(outline_iou(corners, wrapped, azimuth_deg=-90.0, elevation_deg=0.0), 4),
        "iou_front": round(outline_iou(corners, wrapped, azimuth_deg=0.0, elevation_deg=0.0), 4),
        "hausdorff_m": round(float(max(to_mesh.max(), to_template.max())), 4),
        "median_m": round(float(np.median(to_mesh)), 4),
        "p95_m": round(float(np.percentile(to_mesh, 95)), 4),
        "crossings": self_intersections(wrapping.vertices, template.faces),
    }


def _distances(
    start: tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]],
    goal: tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]],
) -> Float[np.ndarray, " K"]:
    """From one in five points to the other surface, or to the nearest point's plane within 2 px."""
    points = start[0][::_EVERY]
    tree = cKDTree(goal[0], balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(points)
    offset = points - goal[0][nearest]
    plane = np.abs((offset * goal[1][nearest]).sum(1))
    beside = np.sqrt((distance**2 - plane**2).clip(0.0))
    return np.where(beside < 2 * _PIXEL_M, plane, distance)
