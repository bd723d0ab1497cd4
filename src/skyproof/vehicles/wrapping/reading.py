"""Reads a textured mesh file: OBJ, GLB, glTF and others through trimesh, COLLADA by ourselves."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.resolvers import Resolver

from skyproof.errors import ConfigurationError
from skyproof.vehicles.wrapping.collada import read_collada
from skyproof.vehicles.wrapping.meshes import (
    GREY,
    Material,
    SourceMesh,
    find_texture,
    picture_bytes,
)

__all__ = ["read_mesh"]

_PICTURES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff")


class _Neighbours(Resolver):
    """Gives trimesh the files that a mesh names, by the rule of `find_texture`."""

    def __init__(self, mesh: Path, missing: tuple[str, ...] = ()) -> None:
        self.mesh = mesh
        self.missing = list(missing)
        self.found = list[str]()

    def get(self, key: str) -> bytes:
        # Options of a map statement, such as "-s 1 1 1", stand before the name.
        path = find_texture(self.mesh, key) or find_texture(self.mesh, key.split()[-1])
        if path is None:
            if Path(key).suffix.lower() in _PICTURES:
                self.missing.append(key.strip())
            raise FileNotFoundError(key)
        if path != self.mesh.parent / key.strip():
            self.found.append(f"{key.strip()} was not there; {path} was taken.")
        return path.read_bytes()

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> _Neighbours:
        return self

    def keys(self) -> list[str]:
        return []


def read_mesh(path: Path) -> SourceMesh:
    """Reads OBJ, GLB, glTF, DAE, or what else trimesh reads; all objects of a scene become one.

    Raises:
        ConfigurationError: the file is missing, unreadable, or has no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path} is not a file; give an OBJ, GLB or DAE mesh.")
    # trimesh reports a missing texture with a traceback in its log; the resolver does so in one
    # sentence.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        mesh = read_collada(path) if path.suffix.lower() == ".dae" else _read_with_trimesh(path)
    except ConfigurationError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigurationError(
            f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or DAE file."
        ) from error
    return _without_flat_triangles(path, mesh)


def _read_with_trimesh(path: Path) -> SourceMesh:
    resolver = _Neighbours(path)
    scene = trimesh.load_scene(path, resolver=resolver, process=False)
    pieces = []
    materials = []
    notes = list(resolver.found)
    clouds = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh):
            clouds += 1
            continue
        if len(geometry.faces) == 0:
            continue
        corners = trimesh.transform_points(geometry.vertices, transform)[geometry.faces]
        if np.linalg.det(transform[:3, :3]) < 0:
            notes.append(f"{node} is mirrored in the file; its triangles were turned round.")
        material, uvs, colours = _look_of(geometry, f"{node} {name}")
        materials.append(material)
        pieces.append((corners, uvs, colours, np.full(len(corners), len(materials) - 1)))
    if not pieces:
        what = "only points or lines, no triangles" if clouds else "no triangles"
        raise ConfigurationError(f"{path} holds {what}; give a mesh with faces.")
    for name in dict.fromkeys(resolver.missing):
        notes.append(f"texture {name} was not found beside {path}; a plain colour was taken.")
    if len(pieces) > 1:
        notes.append(f"{len(pieces)} objects were joined.")
    up = "y" if path.suffix.lower() in (".glb", ".gltf") else None
    unit_m = 1.0 if up else None
    triangles, uvs, colours, material_of = (
        np.concatenate(parts) for parts in zip(*pieces, strict=True)
    )
    return SourceMesh(
        triangles, uvs, colours, material_of, tuple(materials), up, unit_m, tuple(notes)
    )


def _look_of(
    geometry: trimesh.Trimesh, name: str
) -> tuple[Material, Float[np.ndarray, "F 3 2"], Float[np.ndarray, "F 3 3"]]:
    """Returns material, UVs and corner colours of one trimesh object."""
    count = len(geometry.faces)
    uvs = np.zeros((count, 3, 2))
    colours = np.full((count, 3, 3), np.nan)
    visual: Any = geometry.visual
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors, float)[geometry.faces][..., :3] / 255
    elif visual.kind == "face":
        colours = np.repeat(np.asarray(visual.face_colors, float)[:, None, :3] / 255, 3, axis=1)
    material = getattr(visual, "material", None)
    if material is None:
        return Material(name, plain=visual.kind is None), uvs, colours
    image, opacity, colour = _picture_and_colour(material)
    if getattr(visual, "uv", None) is not None:
        uvs = np.asarray(visual.uv, float)[geometry.faces][..., :2]
    else:
        image = None
    name = f"{name} {material.name or ''}".strip()
    return (
        Material(name, colour or GREY, image, opacity, plain=image is None and colour is None),
        uvs,
        colours,
    )


def _picture_and_colour(
    material: Any,
) -> tuple[np.ndarray | None, float, tuple[float, float, float] | None]:
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    # A factor of 1 without a picture is what readers fill in where the file says nothing.
    raw = getattr(material, "baseColorFactor", None)
    if hasattr(material, "kwargs"):
        raw = material.diffuse if "kd" in material.kwargs else None
    opacity = 1.0
    if hasattr(material, "kwargs") and "d" in material.kwargs:
        opacity = min(max(float(np.ravel(material.kwargs["d"])[0]), 0.0), 1.0)
    elif raw is not None and getattr(material, "alphaMode", None) == "BLEND":
        opacity = float(np.asarray(raw, float)[-1] / 255)
    colour = None
    if raw is not None:
        r, g, b = (np.asarray(raw, float)[:3] / 255).tolist()
        colour = (r, g, b)
    return None if image is None else picture_bytes(image), opacity, colour


def _without_flat_triangles(path: Path, mesh: SourceMesh) -> SourceMesh:
    """Drops triangles without area or with coordinates that are no numbers, and says so."""
    a, b, c = mesh.corners.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    size = np.ptp(mesh.corners[np.isfinite(mesh.corners).all((1, 2))].reshape(-1, 3), axis=0).max(
        initial=0.0
    )
    good = np.isfinite(area) & (area > 1e-12 * size**2)
    if not good.any():
        raise ConfigurationError(f"{path} holds no triangle with an area; give a mesh with faces.")
    notes = mesh.notes
    if not good.all():
        notes = (*notes, f"{int((~good).sum())} triangles without area were left out.")
    names = ("corners", "uvs", "colours", "material")
    return replace(mesh, **{name: getattr(mesh, name)[good] for name in names}, notes=notes)
