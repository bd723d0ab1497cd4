"""Finds which point of a mesh each texel of the shared map shows, and its colour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from skyproof.geometry.meshes import vertex_normals
from skyproof.vehicles.template import make_template
from skyproof.vehicles.vehicle import TEXTURE_SIZE
from skyproof.vehicles.wrapping.meshes import SourceMesh
from skyproof.vehicles.wrapping.surface import Wrapping
from skyproof.vehicles.wrapping.views import Outer, parallel_view

# Distance that facing the opposite way adds, so that the two sides of a thin wall stay apart.
_TURN_M = 0.15
_NEIGHBOURS = 3
_OUTSIDE_M = 0.03


@dataclass(frozen=True)
class Texels:
    """The texels of a wrapped vehicle, with visible face, sRGB, and opacity or paint mask."""

    points: Float[np.ndarray, "512 512 3"]
    normals: Float[np.ndarray, "512 512 3"]
    face: Int[np.ndarray, "512 512"]
    alpha: Float[np.ndarray, "512 512"]
    colour: Float[np.ndarray, "512 512 3"]


def bake(
    mesh: SourceMesh, outer: Outer, wrapping: Wrapping, mask: UInt8[np.ndarray, "H W"] | None
) -> Texels:
    """Colours every texel as the nearest outer surface of the mesh that faces the same way."""
    points, normals = _texel_places(wrapping)
    kept = np.flatnonzero(wrapping.hull.inside(outer.points, _OUTSIDE_M))
    known = np.hstack([outer.points[kept], _TURN_M / 2 * outer.normals[kept]])
    tree = cKDTree(known, balanced_tree=False, compact_nodes=False)
    wanted = np.concatenate([points, _TURN_M / 2 * normals], axis=-1).reshape(-1, 6)
    distance, nearest = tree.query(wanted, k=_NEIGHBOURS, eps=0.02)
    nearest = kept[nearest]
    colours, alphas = mesh.look(outer.face, outer.weights, mask)
    weight = 1 / (distance + 0.004)
    # Averages only points of the nearest one's material, so that tyres do not bleed into arches.
    weight *= mesh.material[outer.face[nearest]] == mesh.material[outer.face[nearest[:, :1]]]
    weight /= weight.sum(1, keepdims=True)
    shape = (TEXTURE_SIZE, TEXTURE_SIZE)
    return Texels(
        points,
        normals,
        outer.face[nearest[:, 0]].reshape(shape),
        (weight * alphas[nearest]).sum(1).reshape(shape),
        (weight[..., None] * colours[nearest]).sum(1).reshape(*shape, 3),
    )


def _texel_places(
    wrapping: Wrapping,
) -> tuple[Float[np.ndarray, "512 512 3"], Float[np.ndarray, "512 512 3"]]:
    """Finds each texel's centre on the wrapped template, and the surface normal there."""
    template = make_template()
    uv = template.uvs[template.face_uvs].double().numpy()
    flat = np.concatenate([uv, np.zeros_like(uv[..., :1])], axis=-1)
    seen = parallel_view(flat, np.zeros(2), 1 / TEXTURE_SIZE, (TEXTURE_SIZE, TEXTURE_SIZE))
    # The map is empty between the triangles at the two poles; the nearest texel stands in.
    nearest = distance_transform_edt(seen.face < 0, return_distances=False, return_indices=True)
    face, weights = (values[tuple(nearest)] for values in seen)
    vertices = wrapping.vertices
    normal = vertex_normals(vertices[None], template.faces)[0]
    corners, corner_normals = (v[template.faces].double().numpy() for v in (vertices, normal))
    points = np.einsum("hwk,hwkc->hwc", weights, corners[face])
    normals = np.einsum("hwk,hwkc->hwc", weights, corner_normals[face])
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True).clip(1e-9)
