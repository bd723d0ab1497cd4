"""Gradients at silhouettes: a moving edge covers more or less of a pixel, unseen by sampling."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import at_corners, mesh_edges
from skyproof.geometry.rasterise import Visibility, enumerate_counts, face_areas


@dataclass(frozen=True)
class SilhouettePoints:
    """Points along all visible silhouettes, one for every piece of at most a sample's length.

    The exact derivative of an area-sampled picture is the integral, along its silhouettes, of the
    colour inside less the colour outside times the edge's outward speed. These points are its
    midpoint rule.

    Attributes:
        vehicle, face: front-facing triangle that ends at the edge.
        weights: barycentric weights of the point in that triangle.
        outside: flat index of the sample just outside the edge.
        coverage: zero in value; its derivative is the area in samples that the piece sweeps.
    """

    place: Float[Tensor, "2 K"]
    vehicle: Int[Tensor, " K"]
    face: Int[Tensor, " K"]
    weights: Float[Tensor, "3 K"]
    outside: Int[Tensor, " K"]
    coverage: Float[Tensor, " K"]


def silhouette_points(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    visibility: Visibility,
) -> SilhouettePoints:
    """Finds the visible silhouettes of closed meshes; arguments as for `rasterise`.

    A piece is visible if the sample just outside it is farther than the edge, or empty. The colour
    inside is that of its own triangle at the edge, because the nearest sample inside a thin
    triangle may show something else.
    """
    edges, edge_faces = mesh_edges(faces)
    size = visibility.keys.shape[-1]
    planes = screen.flatten(0, 1).t()
    with torch.no_grad():
        # Silhouettes: edges between a face towards the viewer and one that faces away.
        front = face_areas(at_corners(screen, faces)).view(len(screen), -1) > 0
        first = front.index_select(1, edge_faces[:, 0])
        second = front.index_select(1, edge_faces[:, 1])
        vehicle, edge = torch.nonzero(first != second, as_tuple=True)
        # Walking the edge as the front face does (counter-clockwise, y down) keeps it on the left.
        forward = first[vehicle, edge]
        one, other = edges.index_select(0, edge).t()
        start_vertex = torch.where(forward, one, other)
        end_vertex = torch.where(forward, other, one)
        start_index = vehicle * screen.shape[1] + start_vertex
        end_index = vehicle * screen.shape[1] + end_vertex
        start = planes.index_select(1, start_index)
        whole = planes.index_select(1, end_index) - start
        one, other = edge_faces.index_select(0, edge).t()
        face = torch.where(forward, one, other)
        # Cut into pieces at most a sample long, each with a point in its middle.
        pieces = whole.norm(dim=0).ceil().clamp(min=1).long()
        row, step = enumerate_counts(pieces)
        along = (step.to(screen.dtype) + 0.5) / pieces.index_select(0, row)
        # Visible are the points whose sample just outside lies farther away.
        piece = whole / pieces
        outward = torch.stack((-piece[1], piece[0]))
        unit = outward / (outward.norm(dim=0) + 1e-12)
        place = torch.addcmul(start.index_select(1, row), along, whole.index_select(1, row))
        x, y = (place + unit.index_select(1, row)).floor().long()
        held = (x >= 0) & (x < size) & (y >= 0) & (y < size)
        outside = (vehicle.index_select(0, row) * size + y.clamp(0, size - 1)) * size
        outside = outside + x.clamp(0, size - 1)
        flat_depth = depth.flatten()
        near = torch.lerp(
            flat_depth.index_select(0, start_index).index_select(0, row),
            flat_depth.index_select(0, end_index).index_select(0, row),
            along,
        )
        kept = torch.nonzero(held & (visibility.depth(outside) > near + 1e-3))[:, 0]
        row = row.index_select(0, kept)
        along = along.index_select(0, kept)
        face = face.index_select(0, row)
        corners = faces.index_select(0, face).t()
        weights = (corners == start_vertex.index_select(0, row)) * (1 - along)
        weights = weights + (corners == end_vertex.index_select(0, row)) * along
    # The area that a moving piece sweeps, as a derivative.
    point = torch.lerp(
        planes.index_select(1, start_index.index_select(0, row)),
        planes.index_select(1, end_index.index_select(0, row)),
        along,
    )
    swept = ((point - point.detach()) * outward.index_select(1, row)).sum(0)
    return SilhouettePoints(
        point.detach(),
        vehicle.index_select(0, row),
        face,
        weights,
        outside.index_select(0, kept),
        swept,
    )
