"""Normals, edges and volume of triangle meshes."""

from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor


def at_corners(values: Float[Tensor, "N V C"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "3 C M"]:
    """Returns vertex values at the three corners of every face, mesh by mesh: M = N * F.

    Every corner's every channel is one plane: arithmetic on rows of two or three numbers is slow.
    """
    count, vertices, channels = values.shape
    meshes = torch.arange(count, device=faces.device)[:, None] * vertices
    place = (faces.t()[:, None] + meshes).flatten()
    planes = values.flatten(0, 1).t().index_select(1, place)
    return planes.view(channels, 3, -1).transpose(0, 1)


def vertex_normals(
    vertices: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "N V 3"]:
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


def enclosed_volume_m3(
    vertices: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, " N"]:
    """Returns the volume inside closed meshes, by the divergence theorem; vertices are in metres.

    Space that is enclosed twice counts twice. Faces are counter-clockwise seen from outside, else
    the volume is negative.
    """
    # Coordinates are centred, so that the sum has no large terms that cancel.
    corners = (vertices - vertices.mean(dim=1, keepdim=True)).double()[:, faces]
    a, b, c = corners.unbind(2)
    return ((torch.linalg.cross(a, b) * c).sum(-1).sum(-1) / 6).to(vertices.dtype)


@lru_cache(maxsize=8)
def mesh_edges(faces: Int[Tensor, "F 3"]) -> tuple[Int[Tensor, "E 2"], Int[Tensor, "E 2"]]:
    """Returns the undirected edges of a closed mesh and the two faces at each.

    The first face has the edge in the given order, the second in the opposite order.
    """
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
