"""Reads a textured mesh file into plain triangles with UVs and materials, whatever its format."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image, UnidentifiedImageError
from trimesh.resolvers import Resolver

from skyproof.errors import ConfigurationError

__all__ = ["GREY", "Material", "SourceMesh", "find_texture", "open_texture", "read_mesh"]

GREY = (0.6, 0.6, 0.6)
_PICTURES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff")
_DARK_CABIN = 0.08  # what is seen through a transparent window


@dataclass(frozen=True)
class Material:
    """How some triangles look.

    Attributes:
        name: of the material and of the object it was found on.
        colour: sRGB in [0, 1], used where there is neither a texture nor vertex colours.
        picture: `[H, W, 3 or 4]` bytes, row 0 on top; or none.
        opacity: 1 for solid.
        plain: the file says nothing about its colour: `colour` is a stand-in.
    """

    name: str
    colour: tuple[float, float, float] = GREY
    picture: UInt8[np.ndarray, "H W C"] | None = None
    opacity: float = 1.0
    plain: bool = False


@dataclass(frozen=True)
class SourceMesh:
    """Triangles of all objects of a file together.

    Attributes:
        corners: `[F, 3, 3]`, in the file's axes and unit until it is oriented.
        uvs: `[F, 3, 2]`, v from the bottom of the picture; may lie outside [0, 1], then the picture repeats.
        colours: `[F, 3, 3]` sRGB at the corners; NaN where a texture or a material says it.
        material: `[F]` index into `materials`.
        materials: what the triangles are made of.
        up: axis that the format says is up, or none.
        unit_m: metres per unit that the file says, or none.
        notes: what was repaired or assumed while reading, one sentence each.
    """

    corners: Float[np.ndarray, "F 3 3"]
    uvs: Float[np.ndarray, "F 3 2"]
    colours: Float[np.ndarray, "F 3 3"]
    material: Int[np.ndarray, " F"]
    materials: tuple[Material, ...]
    up: str | None = None
    unit_m: float | None = None
    notes: tuple[str, ...] = field(default=())

    def look(
        self, face: Int[np.ndarray, " N"], weights: Float[np.ndarray, "N 3"], mask: UInt8[np.ndarray, "H W"] | None = None
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Colour and opacity of points on triangles.

        Args:
            face: which triangle.
            weights: where on it, barycentric.
            mask: read in place of the pictures' own alpha, by the same UVs.

        Returns:
            sRGB in [0, 1], and opacity in [0, 1] of the picture (not of the material).
        """
        uv = np.einsum("nk,nkc->nc", weights, self.uvs[face])
        colours = np.einsum("nk,nkc->nc", weights, self.colours[face])
        alpha = np.ones(len(face))
        for index, material in enumerate(self.materials):
            own = self.material[face] == index
            missing = own & np.isnan(colours[:, 0])
            colours[missing] = material.colour
            if material.picture is not None and own.any():
                texels = _sample(material.picture, uv[own]) / 255
                colours[own], alpha[own] = texels[:, :3], texels[:, 3] if texels.shape[1] == 4 else 1.0
            if material.opacity < 1:
                colours[own] = material.opacity * colours[own] + (1 - material.opacity) * _DARK_CABIN
        if mask is not None:
            alpha = _sample(mask[..., None], uv)[:, 0] / 255
        return colours, alpha


def _sample(picture: UInt8[np.ndarray, "H W C"], uv: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N C"]:
    """Bilinear between texel centres; the picture repeats."""
    height, width = picture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = (x - left)[:, None], (y - top)[:, None]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper = picture[rows[0], columns[0]] * (1 - right) + picture[rows[0], columns[1]] * right
    lower = picture[rows[1], columns[0]] * (1 - right) + picture[rows[1], columns[1]] * right
    return upper * (1 - down) + lower * down


def find_texture(mesh: Path, name: str) -> Path | None:
    """The picture that a mesh file names, or the one of that name in a neighbouring folder.

    Looked for in this order: at the path given; as `model://<model>/...` beside this model's folder; then by file name,
    without regard to case, in the mesh's folder, its `textures` and `materials/textures`, and those one folder up.
    """
    name = name.strip().replace("\\", "/").removeprefix("file://")
    if name.startswith("model://"):
        name = name.removeprefix("model://")
        candidate = mesh.parents[2] / name if len(mesh.parents) > 2 else mesh.parent / name
    else:
        candidate = mesh.parent / name
    if candidate.is_file():
        return candidate
    for folder in (mesh.parent, mesh.parent.parent):
        for place in (folder, folder / "textures", folder / "materials" / "textures"):
            for path in sorted(place.iterdir()) if place.is_dir() else []:
                if path.name.lower() == Path(name).name.lower() and path.is_file():
                    return path
    return None


class _Neighbours(Resolver):
    """Gives trimesh the files that a mesh names, by the rule of `find_texture`."""

    def __init__(self, mesh: Path, missing: tuple[str, ...] = ()) -> None:
        self.mesh, self.missing, self.found = mesh, list(missing), list[str]()

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
    from skyproof.vehicles.wrap_collada import read_collada

    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path} is not a file; give an OBJ, GLB or DAE mesh.")
    # trimesh reports a missing texture with a traceback in its log; the resolver does so in one sentence.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        mesh = read_collada(path) if path.suffix.lower() == ".dae" else _read_with_trimesh(path)
    except ConfigurationError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigurationError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or DAE file.") from error
    return _without_flat_triangles(path, mesh)


def _read_with_trimesh(path: Path) -> SourceMesh:
    resolver = _Neighbours(path)
    scene = trimesh.load_scene(path, resolver=resolver, process=False)
    pieces, materials, notes = [], [], list(resolver.found)
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
    joined = [np.concatenate(parts) for parts in zip(*pieces, strict=True)]
    return SourceMesh(*joined, materials=tuple(materials), up=up, unit_m=unit_m, notes=tuple(notes))


def _look_of(geometry: trimesh.Trimesh, name: str) -> tuple[Material, np.ndarray, np.ndarray]:
    """Material, UVs and corner colours of one trimesh object."""
    count = len(geometry.faces)
    uvs, colours = np.zeros((count, 3, 2)), np.full((count, 3, 3), np.nan)
    visual = geometry.visual
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
    return Material(name, colour or GREY, image, opacity, plain=image is None and colour is None), uvs, colours


def _picture_and_colour(material: Any) -> tuple[np.ndarray | None, float, tuple[float, float, float] | None]:
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
    return None if image is None else _pixels(image), opacity, colour


def open_texture(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """A picture as bytes, `[H, W, 3]` or with alpha `[H, W, 4]`.

    Raises:
        ConfigurationError: it cannot be read.
    """
    try:
        with Image.open(path) as image:
            return _pixels(image)
    except (OSError, UnidentifiedImageError) as error:
        raise ConfigurationError(f"{path} cannot be read as a picture; give a PNG or JPEG.") from error


def _pixels(image: Image.Image) -> UInt8[np.ndarray, "H W C"]:
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if has_alpha else "RGB"))


def _without_flat_triangles(path: Path, mesh: SourceMesh) -> SourceMesh:
    """Drops triangles without area or with coordinates that are no numbers, and says so."""
    a, b, c = mesh.corners.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    size = np.ptp(mesh.corners[np.isfinite(mesh.corners).all((1, 2))].reshape(-1, 3), axis=0).max(initial=0.0)
    good = np.isfinite(area) & (area > 1e-12 * size**2)
    if not good.any():
        raise ConfigurationError(f"{path} holds no triangle with an area; give a mesh with faces.")
    notes = mesh.notes
    if not good.all():
        notes = (*notes, f"{int((~good).sum())} triangles without area were left out.")
    names = ("corners", "uvs", "colours", "material")
    return replace(mesh, **{name: getattr(mesh, name)[good] for name in names}, notes=notes)
