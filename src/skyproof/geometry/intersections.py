"""Counts self-intersections of a triangle mesh."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# Volumes below this share of the mesh's own cube count as touching, not crossing; float64 keeps far
# below it.
_TOUCHING = 1e-13
_CHUNK = 65_536


@torch.no_grad()
def self_intersections(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> int:
    """Counts the pairs of triangles in which an edge of one passes through the inside of the other.

    Triangles that share a vertex are neighbours and never count, even if one is folded through the
    other. Touching and coplanar triangles do not count either.
    """
    triangles = vertices.double()[faces]
    if not len(triangles):
        return 0
    size = float((vertices.amax(0) - vertices.amin(0)).max())
    count = 0
    for first, second in zip(
        *(side.split(_CHUNK) for side in _near_pairs(triangles, faces)), strict=True
    ):
        count += int(_cross(triangles[first], triangles[second], _TOUCHING * size**3).sum())
    return count


def _near_pairs(triangles: Float[Tensor, "F 3 3"], faces: Int[Tensor, "F 3"]) -> Int[Tensor, "2 P"]:
    """Returns the pairs without a common vertex whose boxes overlap."""
    low = triangles.amin(1)
    high = triangles.amax(1)
    overlap = torch.ones(len(faces), len(faces), dtype=torch.bool, device=faces.device).triu(1)
    for axis in range(3):
        overlap &= low[:, None, axis] < high[None, :, axis]
        overlap &= low[None, :, axis] < high[:, None, axis]
    first, second = overlap.nonzero(as_tuple=True)
    apart = (faces[first][:, :, None] != faces[second][:, None, :]).all(2).all(1)
    return torch.stack((first[apart], second[apart]))


def _cross(
    a: Float[Tensor, "P 3 3"], b: Float[Tensor, "P 3 3"], touching: float
) -> Bool[Tensor, " P"]:
    """Whether an edge of one triangle passes through the other."""
    return _edge_through(a, b, touching) | _edge_through(b, a, touching)


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
        apart = (torch.minimum(above[:, start], above[:, end]) < -touching) & (
            torch.maximum(above[:, start], above[:, end]) > touching
        )
        around = torch.stack(
            (_volume(p, q, b0, b1), _volume(p, q, b1, b2), _volume(p, q, b2, b0)), dim=1
        )
        through |= apart & ((around > touching).all(1) | (around < -touching).all(1))
    return through


def _volume(
    a: Float[Tensor, "P 3"],
    b: Float[Tensor, "P 3"],
    c: Float[Tensor, "P 3"],
    d: Float[Tensor, "P 3"],
) -> Float[Tensor, " P"]:
    """Returns six times the signed volume of a tetrahedron."""
    return (torch.linalg.cross(b - a, c - a) * (d - a)).sum(-1)
