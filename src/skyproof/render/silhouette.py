"""Gradients at silhouettes: a moving edge covers more or less of a pixel, unseen by sampling."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import mesh_edges
from skyproof.geometry.rasterise import Visibility, face_areas

__all__ = ["SilhouettePoints", "silhouette_points"]


@dataclass(frozen=True)
class SilhouettePoints:
    """Points along all visible silhouettes, one for every piece of at most a sample's length.

    The exact derivative of an area-sampled picture is the integral, along its silhouettes, of the
    colour inside less the colour outside times the edge's outward speed. These points are that
    integral's midpoint rule.

    Attributes:
        place: `[K, 2]` the point itself, in samples.
        vehicle, face: `[K]` the front-facing triangle that ends at this edge.
        weights: `[K, 3]` barycentric weights of the point in that triangle.
        outside: `[K]` flat index of the sample just outside the edge.
        coverage: `[K]` zero in value; its derivative is the area, in samples, that the piece
            sweeps.
    """

    place: Float[Tensor, "K 2"]
    vehicle: Int[Tensor, " K"]
    face: Int[Tensor, " K"]
    weights: Float[Tensor, "K 3"]
    outside: Int[Tensor, " K"]
    coverage: Float[Tensor, " K"]


def silhouette_points(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    visibility: Visibility,
) -> SilhouettePoints:
    """Finds the visible silhouettes of closed meshes; arguments as for `rasterise`.

    A piece is visible where the sample just outside it is farther away than the edge, or empty. The
    colour inside is to be taken at the edge itself, in its own triangle: such triangles are often
    thinner than a sample, so that the nearest sample inside may show something else.
    """
    edges, edge_faces = mesh_edges(faces)
    size = visibility.keys.shape[-1]
    # Silhouettes: edges between a face towards the viewer and one that faces away.
    with torch.no_grad():
        front = face_areas(screen, faces) > 0
        first, second = front[:, edge_faces[:, 0]], front[:, edge_faces[:, 1]]
        vehicle, edge = torch.nonzero(first != second, as_tuple=True)
        # Walking the edge as the front face does (counter-clockwise, y down) keeps it on the left.
        forward = first[vehicle, edge]
        ends = edges[edge]
        start_index = torch.where(forward, ends[:, 0], ends[:, 1])
        end_index = torch.where(forward, ends[:, 1], ends[:, 0])
        # Cut into pieces at most a sample long, each with a point in its middle.
        length = (screen[vehicle, end_index] - screen[vehicle, start_index]).norm(dim=-1)
        pieces = length.ceil().clamp(min=1).long()
        row = torch.repeat_interleave(torch.arange(len(pieces), device=screen.device), pieces)
        step = torch.arange(len(row), device=screen.device) - (pieces.cumsum(0) - pieces)[row]
        along = ((step.to(screen.dtype) + 0.5) / pieces[row])[:, None]
        vehicle, edge = vehicle[row], edge[row]
        start_index, end_index = start_index[row], end_index[row]

    start, end = screen[vehicle, start_index], screen[vehicle, end_index]
    point = torch.lerp(start, end, along)
    # Visible are the points whose sample just outside lies farther away.
    with torch.no_grad():
        piece = (end - start) / pieces[row][:, None]
        outward = torch.stack((-piece[:, 1], piece[:, 0]), dim=-1)
        unit = outward / (outward.norm(dim=-1, keepdim=True) + 1e-12)
        beyond = (point + unit).floor().long()
        near = torch.lerp(
            depth[vehicle, start_index][:, None], depth[vehicle, end_index][:, None], along
        )[:, 0]
        held = ((beyond >= 0) & (beyond < size)).all(-1)
        beyond = beyond.clamp(0, size - 1)
        outside = (vehicle * size + beyond[:, 1]) * size + beyond[:, 0]
        kept = held & (visibility.depth(outside) > near + 1e-3)
        vehicle, along = vehicle[kept], along[kept]
        face = torch.where(forward[row], edge_faces[edge, 0], edge_faces[edge, 1])[kept]
        corners = faces[face]
        weights = (corners == start_index[kept][:, None]) * (1 - along) + (
            corners == end_index[kept][:, None]
        ) * along
    # The area that a moving piece sweeps, as a derivative.
    swept = ((point - point.detach()) * outward).sum(-1)
    return SilhouettePoints(
        point.detach()[kept], vehicle, face, weights, outside[kept], swept[kept]
    )
