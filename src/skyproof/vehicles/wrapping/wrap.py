"""Brings a mesh file onto the shared template: vertices, texture, parts, and how well it fits."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.geometry.meshes import self_intersections
from skyproof.pictures import decoded, open_picture
from skyproof.vehicles.template import make_template
from skyproof.vehicles.wrapping.baking import bake
from skyproof.vehicles.wrapping.meshes import SourceMesh
from skyproof.vehicles.wrapping.orientation import orient
from skyproof.vehicles.wrapping.parts import PLAIN_COLOURS, label_parts
from skyproof.vehicles.wrapping.reading import read_mesh
from skyproof.vehicles.wrapping.surface import Wrapping, wrap_surface
from skyproof.vehicles.wrapping.views import Outer, look_around, parallel_view, view_axes

_ALPHA_SHARE = 0.02
_PIXEL_M = 0.01
_EVERY = 5  # points are dense enough for one in five

_Corners = Float[np.ndarray, "_ 3 3"]


@dataclass(frozen=True)
class WrappedVehicle:
    """One mesh, oriented, on the template; the report covers axes, fit, labels and repairs."""

    mesh: SourceMesh
    vertices: Float[Tensor, "994 3"]
    texture: UInt8[Tensor, "3 512 512"]
    parts: UInt8[Tensor, "512 512"]
    report: dict[str, Any]


def wrap_mesh(
    path: Path,
    *,
    scale: float | None = None,
    up: str | None = None,
    forward: str | None = None,
    paintable: Path | None = None,
) -> WrappedVehicle:
    """Wraps one mesh file, as `WrapSettings` say; a texture's alpha counts only if it varies.

    Raises:
        ConfigurationError: unreadable, no triangles, not a vehicle's size, or axes that do not fit.
    """
    mask = None if paintable is None else _read_mask(paintable)
    mesh, facts = orient(read_mesh(path), scale=scale, up=up, forward=forward)
    notes = list(mesh.notes)
    outer = look_around(mesh.corners)
    if outer.inverted:
        notes.append(
            f"{outer.inverted} of {outer.seen} visible triangles face inwards; they were turned "
            "round."
        )
    pictures = any(m.picture is not None for m in mesh.materials)
    if not pictures and np.isnan(mesh.colours).any():
        notes.append("no texture: plain colours of materials or parts are used.")
    wrapping = wrap_surface(mesh.corners)
    texels = bake(mesh, outer, wrapping, mask)
    clear = float((texels.alpha < 0.5).mean())
    masked = mask is not None or _ALPHA_SHARE < clear < 1 - _ALPHA_SHARE
    if masked and mask is None:
        notes.append("the texture's alpha is taken as a mask of what is paint.")
    plain = np.array([m.plain for m in mesh.materials])[mesh.material[texels.face]]
    plain &= np.isnan(mesh.colours[texels.face, 0, 0])
    if plain.any() and pictures:
        notes.append(
            f"{plain.mean():.0%} of the surface have no colour in the file: plain colours of parts "
            "are used."
        )
    parts, shares, doubts = label_parts(mesh, texels, wrapping, plain, masked=masked)
    stand_ins = np.array(list(PLAIN_COLOURS.values()))[parts]
    colour = np.where(plain[..., None], stand_ins, texels.colour)
    texture = torch.from_numpy((colour.clip(0.0, 1.0) * 255).round().astype(np.uint8))
    size_m = wrapping.vertices.amax(0) - wrapping.vertices.amin(0)
    report = {
        "mesh": str(path),
        "triangles": len(mesh.corners),
        **facts,
        "size_m": [round(value, 3) for value in size_m.tolist()],
        **_measure_fit(mesh.corners, outer, wrapping),
        "parts_by": shares,
        "notes": notes + doubts,
    }
    texture = texture.permute(2, 0, 1).contiguous()
    return WrappedVehicle(mesh, wrapping.vertices, texture, torch.from_numpy(parts), report)


def _read_mask(path: Path) -> UInt8[np.ndarray, "H W"]:
    remedy = "give a PNG mask with --wrapping.paintable"
    with open_picture(path, remedy, error=ConfigurationError, also=("TGA", "GIF")) as image:
        return decoded(image, "L", str(path), remedy, error=ConfigurationError, also=("TGA", "GIF"))


def _measure_fit(corners: _Corners, outer: Outer, wrapping: Wrapping) -> dict[str, float | int]:
    """Compares the wrapped template with the mesh.

    Distances run from points about 3 cm apart on each outer surface, as seen from the sides and
    from above, to the other's surface.

    Returns:
        iou_above, iou_side, iou_front: of outlines with mirrors; hausdorff_m: the largest distance
        either way; median_m, p95_m: from mesh to vehicle; crossings: pairs of crossing triangles.
    """
    faces = make_template().faces
    wrapped = wrapping.vertices.double().numpy()[faces.numpy()]
    skin = look_around(wrapped)
    clouds = [(cloud.points[~cloud.below], cloud.normals[~cloud.below]) for cloud in (outer, skin)]
    to_mesh = _distances(*clouds)
    to_template = _distances(*clouds[::-1])
    measures = {
        "iou_above": _outline_iou(corners, wrapped, -90.0, 90.0),
        "iou_side": _outline_iou(corners, wrapped, -90.0, 0.0),
        "iou_front": _outline_iou(corners, wrapped, 0.0, 0.0),
        "hausdorff_m": float(max(to_mesh.max(), to_template.max())),
        "median_m": float(np.median(to_mesh)),
        "p95_m": float(np.percentile(to_mesh, 95)),
    }
    rounded = {name: round(value, 4) for name, value in measures.items()}
    return {**rounded, "crossings": self_intersections(wrapping.vertices, faces)}


def _outline_iou(
    first: _Corners, second: _Corners, azimuth_deg: float, elevation_deg: float
) -> float:
    """Returns the intersection over union of two meshes' outlines at 1 cm per pixel."""
    axes = view_axes(azimuth_deg, elevation_deg)
    views = [corners @ axes.T for corners in (first, second)]
    points = np.concatenate([view.reshape(-1, 3) for view in views])[:, :2]
    low = points.min(0) - _PIXEL_M
    high = points.max(0) + _PIXEL_M
    columns, rows = np.ceil((high - low) / _PIXEL_M).astype(int).tolist()
    one, other = (parallel_view(view, low, _PIXEL_M, (rows, columns)).face >= 0 for view in views)
    return float((one & other).sum() / (one | other).sum())


def _distances(
    start: tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]],
    goal: tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]],
) -> Float[np.ndarray, " K"]:
    """Returns distances of one in five points to the other's nearest, or its plane within 2 px."""
    points = start[0][::_EVERY]
    tree = cKDTree(goal[0], balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(points)
    offset = points - goal[0][nearest]
    plane = np.abs((offset * goal[1][nearest]).sum(1))
    beside = np.sqrt((distance**2 - plane**2).clip(0.0))
    return np.where(beside < 2 * _PIXEL_M, plane, distance)
