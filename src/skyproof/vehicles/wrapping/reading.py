"""Reads a textured mesh file through trimesh: OBJ, GLB, glTF and others."""

import io
import logging
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image
from trimesh.resolvers import Resolver

from skyproof.errors import ConfigurationError
from skyproof.geometry.colour import linear_to_srgb
from skyproof.pictures import decoded
from skyproof.vehicles.wrapping.gltf import refuse_misread
from skyproof.vehicles.wrapping.meshes import GREY, Material, SourceMesh, find_texture, is_picture

# Other formats of trimesh are archives, documents with programs, and shapes without triangles.
_FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
_LARGEST_FILE = 500_000_000
# A scene may show a part many times.
_MOST = {"triangles": 5_000_000, "nodes": 100_000, "texels in its textures": 400_000_000}

# trimesh makes up a picture for UVs without material; only pictures from files have a format.
_STAND_IN_PX = (2, 2)


class _Neighbours(Resolver):
    """Gives trimesh the files that a mesh names, by the rule of `find_texture`."""

    def __init__(self, mesh: Path) -> None:
        self.mesh = mesh
        self.notes = list[str]()

    def get(self, key: str) -> bytes:
        # Options of a map statement, such as "-s 1 1 1", stand before the name.
        path = find_texture(self.mesh, key) or find_texture(self.mesh, (key.split() or [""])[-1])
        name = key.strip()
        materials = name.lower().endswith(".mtl")
        if path is None or path.stat().st_size > _LARGEST_FILE:
            lost = f"{name} was not found beside {self.mesh}"
            if materials:
                self.notes.append(f"{lost}; its materials have no colours.")
                return self._named_materials()
            self.notes.append(f"texture {lost}; a plain colour was taken.")
            raise FileNotFoundError(key)
        if path != self.mesh.parent / name:
            self.notes.append(f"{name} was not there; {path} was taken.")
        if is_picture(name) or (self.mesh.suffix.lower() != ".gltf" and not materials):
            self._check_picture(path, name)
        return path.read_bytes()

    def _named_materials(self) -> bytes:
        """Returns the materials that an OBJ names, without colours, as names tell parts."""
        names = re.findall(rb"^[ \t]*usemtl[ \t]+(\S.*?)\s*$", self.mesh.read_bytes(), re.MULTILINE)
        return b"".join(b"newmtl %s\n" % name for name in dict.fromkeys(names))

    def _check_picture(self, path: Path, name: str) -> None:
        """Notes a texture that trimesh would drop silently."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                Image.open(path).close()
        except Exception:
            # Pillow's readers may raise any exception for a damaged file.
            unread = f"texture {name} cannot be read as a picture"
            self.notes.append(f"{unread}; a plain colour was taken.")
            raise

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> "_Neighbours":
        return self

    def keys(self) -> list[str]:
        return []


def read_mesh(path: Path) -> SourceMesh:
    """Reads OBJ, GLB, glTF, PLY, STL or OFF; all objects of a scene become one.

    Nothing in the file runs, and of other files only those that `find_texture` finds are read.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path} is not a file; give an OBJ or GLB mesh.")
    if path.suffix.lower() not in _FORMATS:
        raise ConfigurationError(
            f"{path} is none of the meshes that are read ({', '.join(_FORMATS)}); convert it, "
            "for instance to GLB with Blender."
        )
    if path.stat().st_size > _LARGEST_FILE:
        raise ConfigurationError(
            f"{path} has more than {_LARGEST_FILE / 1e6:.0f} MB, too much for one vehicle; "
            "simplify it."
        )
    # trimesh reports a missing texture with a traceback in its log; the resolver does so in one
    # sentence.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        mesh = _read_with_trimesh(path)
    except ConfigurationError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigurationError(
            f"{path} cannot be read as a mesh ({reason}); give an OBJ or GLB file."
        ) from error
    return _without_flat_triangles(path, mesh)


def _read_with_trimesh(path: Path) -> SourceMesh:
    kind = path.suffix.lower().removeprefix(".")
    gltf = kind in ("glb", "gltf")
    if gltf:
        refuse_misread(path)
    resolver = _Neighbours(path)
    content = _counted_from_the_start(path) if kind == "obj" else None
    scene = trimesh.load_scene(content or path, kind, resolver, process=False)
    pieces = []
    materials = []
    notes = list(dict.fromkeys(resolver.notes))
    clouds = 0
    counts = Counter[str]()
    pictures: dict[int, UInt8[np.ndarray, "H W C"]] = {}
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh):
            clouds += 1
            continue
        count = len(geometry.faces)
        if count == 0:
            continue
        counts.update({"nodes": 1, "triangles": count})
        _refuse_too_much(path, counts)
        if np.linalg.det(transform[:3, :3]) < 0:
            notes.append(f"{node} is mirrored in the file; its triangles were turned round.")
        visual: Any = geometry.visual
        material, picture = _material_of(visual, f"{node} {name}", linear=gltf)
        uvs = np.zeros((count, 3, 2))
        if getattr(visual, "uv", None) is not None:
            uvs = np.asarray(visual.uv, float)[geometry.faces][..., :2]
        if picture is not None:
            if id(picture) not in pictures:
                pictures[id(picture)] = _picture_bytes(picture, f"A texture of {path}")
                counts["texels in its textures"] += picture.width * picture.height
                _refuse_too_much(path, counts)
            texels = pictures[id(picture)]
            if gltf and getattr(visual.material, "alphaMode", None) not in ("MASK", "BLEND"):
                texels = texels[..., :3]
            material = replace(material, picture=texels)
        materials.append(material)
        corners = trimesh.transform_points(geometry.vertices, transform)[geometry.faces]
        colours = _corner_colours(visual, geometry.faces, linear=gltf)
        pieces.append((corners, uvs, colours, np.full(count, len(materials) - 1)))
    if not pieces:
        what = "only points or lines, no triangles" if clouds else "no triangles"
        raise ConfigurationError(f"{path} holds {what}; give a mesh with faces.")
    if len(pieces) > 1:
        notes.append(f"{len(pieces)} objects were joined.")
    corners, uvs, colours, material_of = (
        np.concatenate(parts) for parts in zip(*pieces, strict=True)
    )
    up = "y" if gltf else None
    return SourceMesh(corners, uvs, colours, material_of, tuple(materials), up, tuple(notes))


def _counted_from_the_start(path: Path) -> io.BytesIO | None:
    """Rewrites an OBJ whose faces have negative indices, which count back from their own line.

    trimesh counts back from the end of the file. Returns None if there are no such faces.
    """
    content = path.read_bytes().replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    if not re.search(rb"^f[^\n]*-[0-9]", content, re.MULTILINE):
        return None
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.split(b"\n")
    for number, line in enumerate(lines):
        kind, *corners = line.split() or [b""]
        if kind in counts:
            counts[kind] += 1
        elif kind == b"f" and b"-" in line:
            lines[number] = b"f " + b" ".join(
                _counted(each, [*counts.values()]) for each in corners
            )
    return io.BytesIO(b"\n".join(lines))


def _counted(corner: bytes, counts: Sequence[int]) -> bytes:
    """Converts the indices of a corner, such as -1/-1/-1, to count from the start of the file."""
    numbers = []
    for text, count in zip(corner.split(b"/"), counts, strict=False):
        if text.startswith(b"-") and not -count <= int(text) < 0:
            raise ValueError(f"a face names {text.decode()[:20]} of {count}")
        numbers.append(b"%d" % (count + 1 + int(text)) if text.startswith(b"-") else text)
    return b"/".join(numbers)


def _refuse_too_much(path: Path, counts: Counter[str]) -> None:
    for what, most in _MOST.items():
        if counts[what] > most:
            raise ConfigurationError(
                f"{path} has more than {most:,} {what}, too much for one vehicle; simplify it."
            )


def _picture_bytes(image: Image.Image, place: str) -> UInt8[np.ndarray, "H W C"]:
    """Decodes an open picture, `[H, W, 3]` or with alpha `[H, W, 4]`; errors name `place`."""
    mode = "RGBA" if "A" in image.getbands() or "transparency" in image.info else "RGB"
    remedy = "give a PNG or JPEG as texture"
    return decoded(image, mode, place, remedy, error=ConfigurationError, also=("TGA", "GIF"))


def _corner_colours(
    visual: Any, faces: Int[np.ndarray, "F 3"], *, linear: bool
) -> Float[np.ndarray, "F 3 3"]:
    """The sRGB of corners from vertices or faces, NaN where the object has a material."""
    colours = np.full((len(faces), 3, 3), np.nan)
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors, float)[faces][..., :3] / 255
    elif visual.kind == "face":
        colours = np.repeat(np.asarray(visual.face_colors, float)[:, None, :3] / 255, 3, axis=1)
    return _srgb(colours) if linear else colours


def _material_of(visual: Any, name: str, *, linear: bool) -> tuple[Material, Image.Image | None]:
    """The material of one trimesh object, and its picture if there is one; `linear` as in glTF."""
    material = getattr(visual, "material", None)
    if material is None:
        return Material(name, plain=visual.kind is None), None
    picture, opacity, colour = _picture_and_colour(material, linear=linear)
    if getattr(visual, "uv", None) is None:
        picture = None
    looks = Material(
        f"{name} {material.name or ''}".strip(),
        colour or GREY,
        opacity=opacity,
        plain=picture is None and colour is None,
        # In an OBJ most exporters write a colour that is not meant to tint its texture.
        tint=colour if linear and picture is not None else None,
    )
    return looks, picture


def _srgb(linear: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    return linear_to_srgb(torch.from_numpy(linear)).numpy()


def _picture_and_colour(
    material: Any, *, linear: bool
) -> tuple[Image.Image | None, float, tuple[float, float, float] | None]:
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if image is not None and image.format is None and image.size == _STAND_IN_PX:
        image = None
    # A factor of 1 without a picture is what readers fill in where the file says nothing.
    raw = getattr(material, "baseColorFactor", None)
    given = getattr(material, "kwargs", None)
    if given is not None:
        raw = material.diffuse if "kd" in given else None
    opacity = 1.0
    if given is not None and ("d" in given or "tr" in given):
        value = given["d"] if "d" in given else given["tr"]
        opacity = min(max(float(np.ravel(value)[-1]), 0.0), 1.0)
        opacity = opacity if "d" in given else 1 - opacity
    elif raw is not None and getattr(material, "alphaMode", None) == "BLEND":
        opacity = float(np.asarray(raw, float)[-1] / 255)
    colour = None
    if raw is not None:
        values = np.asarray(raw, float)[:3] / 255
        r, g, b = (_srgb(values) if linear else values).tolist()
        colour = (r, g, b)
    return image, opacity, colour


def _without_flat_triangles(path: Path, mesh: SourceMesh) -> SourceMesh:
    """Drops triangles without area or with coordinates that are not finite, and notes that."""
    a, b, c = mesh.corners.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    finite = np.isfinite(mesh.corners).all((1, 2))
    size = np.ptp(mesh.corners[finite].reshape(-1, 3), axis=0).max() if finite.any() else 0.0
    good = finite & np.isfinite(area) & (area > 1e-12 * size**2)
    if not good.any():
        raise ConfigurationError(f"{path} holds no triangle with an area; give a mesh with faces.")
    notes = mesh.notes
    if not good.all():
        notes = (*notes, f"{int((~good).sum())} triangles without area were left out.")
    names = ("corners", "uvs", "colours", "material")
    return replace(mesh, **{name: getattr(mesh, name)[good] for name in names}, notes=notes)
