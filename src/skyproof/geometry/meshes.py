"""Normals, edges, volume and crossings of triangle meshes."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# Volumes below this share of the cube of the mesh's largest side count as touching, not crossing.
# Rounding errors of float64 stay far below it.
_TOUCHING = 1e-13
_CHUNK = 65_536

_Vertices = Float[Tensor, "N V 3"]
_Faces = Int[Tensor, "F 3"]
_Points = Float[Tensor, "P 3"]


def at_corners(values: Float[Tensor, "N V C"], faces: _Faces) -> Float[Tensor, "3 C M"]:
    """Returns vertex values at the three corners of every face, mesh by mesh: M = N * F.

    Each channel of each corner is one plane, as arithmetic on rows of two or three numbers is slow.
    """
    count, vertices, channels = values.shape
    meshes = torch.arange(count, device=faces.device)[:, None] * vertices
    place = (faces.t()[:, None] + meshes).flatten()
    planes = values.flatten(0, 1).t().index_select(1, place)
    return planes.view(channels, 3, -1).transpose(0, 1)


def vertex_normals(vertices: _Vertices, faces: _Faces) -> _Vertices:
    """Returns unit normals at the vertices: the area-weighted mean of the faces around each."""
    a, b, c = at_corners(vertices, faces)
    face_normals = torch.linalg.cross(b - a, c - a, dim=0)
    count, size, _ = vertices.shape
    meshes = torch.arange(count, device=faces.device)[:, None] * size
    normals = face_normals.new_zeros(3, count * size)
    for corner in faces.t():
        normals = normals.index_add(1, (corner + meshes).flatten(), face_normals)
    # The tiny constant keeps the normal finite if all faces of a vertex have zero area.
    normals = normals / (normals.square().sum(0) + 1e-20).sqrt()
    return normals.t().view(count, size, 3)


def enclosed_volume_m3(vertices: _Vertices, faces: _Faces) -> Float[Tensor, " N"]:
    """Returns the volume inside closed meshes, by the divergence theorem; vertices are in metres.

    Space that is enclosed twice counts twice. Faces are counter-clockwise seen from outside, else
    the volume is negative.
    """
    # Coordinates are centred, so that the sum has no large terms that cancel.
    corners = (vertices - vertices.mean(dim=1, keepdim=True)).double()[:, faces]
    a, b, c = corners.unbind(2)
    return ((torch.linalg.cross(a, b) * c).sum(-1).sum(-1) / 6).to(vertices.dtype)


def mesh_edges(faces: _Faces) -> tuple[Int[Tensor, "E 2"], Int[Tensor, "E 2"]]:
    """Returns a closed mesh's edges and their two faces; the first one has the edge's direction."""
    directed = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    owner = torch.arange(len(faces), device=faces.device).repeat(3)
    count = int(faces.max()) + 1
    forward = directed[:, 0] * count + directed[:, 1]
    backward = directed[:, 1] * count + directed[:, 0]
    forward, order = forward.sort()
    partner = torch.searchsorted(forward, backward[order]).clamp(max=len(forward) - 1)
    if bool((forward[partner] != backward[order]).any()):
        raise ValueError("expected a closed mesh: every edge in two faces, in opposite directions")
    chosen = directed[order][:, 0] < directed[order][:, 1]
    edge_faces = torch.stack((owner[order], owner[order][partner]), dim=1)
    return directed[order][chosen], edge_faces[chosen]


@torch.no_grad()
def self_intersections(vertices: Float[Tensor, "V 3"], faces: _Faces) -> int:
    """Counts the pairs of triangles in which an edge of one passes through the inside of the other.

    Triangles that share a vertex are neighbours and never count, even if one is folded through the
    other. Touching and coplanar triangles do not count either.
    """
    triangles = vertices.double()[faces]
    touching = _TOUCHING * float((vertices.amax(0) - vertices.amin(0)).max()) ** 3
    count = 0
    for first, second in _near_pairs(triangles, faces).split(_CHUNK, dim=1):
        a, b = triangles[first], triangles[second]
        crossing = _edge_through(a, b, touching) | _edge_through(b, a, touching)
        count += int(crossing.sum())
    return count


def _near_pairs(triangles: Float[Tensor, "F 3 3"], faces: _Faces) -> Int[Tensor, "2 P"]:
    """Returns the pairs of triangles without a common vertex whose bounding boxes overlap."""
    low = triangles.amin(1)
    high = triangles.amax(1)
    overlap = torch.ones(len(faces), len(faces), dtype=torch.bool, device=faces.device).triu(1)
    for axis in range(3):
        overlap &= low[:, None, axis] < high[None, :, axis]
        overlap &= low[None, :, axis] < high[:, None, axis]
    first, second = overlap.nonzero(as_tuple=True)
    apart = (faces[first][:, :, None] != faces[second][:, None, :]).all(2).all(1)
    return torch.stack((first[apart], second[apart]))


def _edge_through(
    a: Float[Tensor, "P 3 3"], b: Float[Tensor, "P 3 3"], touching: float
) -> Bool[Tensor, " P"]:
    """Whether an edge of `a` passes through the inside of `b`, by signed volumes."""
    through = torch.zeros(len(a), dtype=torch.bool, device=a.device)
    b0, b1, b2 = b.unbind(1)
    above = torch.stack([_volume(b0, b1, b2, corner) for corner in a.unbind(1)], dim=1)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        p, q = a[:, start], a[:, end]
        # One end on each side of b's plane, and the line on the same side of all three edges of b.
        ends = above[:, [start, end]]
        apart = (ends.amin(1) < -touching) & (ends.amax(1) > touching)
        sides = ((b0, b1), (b1, b2), (b2, b0))
        around = torch.stack([_volume(p, q, *side) for side in sides], dim=1)
        through |= apart & ((around > touching).all(1) | (around < -touching).all(1))
    return through


def _volume(a: _Points, b: _Points, c: _Points, d: _Points) -> Float[Tensor, " P"]:
    """Returns six times the signed volume of a tetrahedron."""
    return (torch.linalg.cross(b - a, c - a) * (d - a)).sum(-1)
