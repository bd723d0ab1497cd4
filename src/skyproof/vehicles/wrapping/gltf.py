"""Refuses glTF files that trimesh reads wrongly, or that unfold to more than memory holds."""

import struct
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from skyproof.documents import parse_document
from skyproof.errors import ConfigurationError

# Default values of KHR_texture_transform and of a texture.
_UNMOVED = {"offset": [0, 0], "rotation": 0, "scale": [1, 1], "texCoord": 0}
_COMPRESSIONS = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"}
_Number = Annotated[int, Meta(ge=0, le=50_000_000)]
_Index = Annotated[int, Meta(ge=0)]
_NUMBERS_EACH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# Positions, normals and UVs of five million triangles without common corners are 120 million.
_MOST_NUMBERS = 150_000_000


class _Accessor(msgspec.Struct):
    """A glTF accessor: `count` elements, which the file need not even hold."""

    count: _Number
    type: str = "MAT4"


class _Primitive(msgspec.Struct):
    attributes: Annotated[dict[str, _Index], Meta(max_length=1000)] = {}
    indices: _Index | None = None
    material: _Index | None = None


class _GltfMesh(msgspec.Struct):
    primitives: Annotated[list[_Primitive], Meta(max_length=100_000)] = []


class _Node(msgspec.Struct):
    mesh: _Index | None = None


class _GltfTexture(msgspec.Struct):
    texCoord: int = 0
    extensions: dict[str, Any] = {}

    def is_moved(self) -> bool:
        """Says whether it uses anything but the unchanged first UVs."""
        transform = self.extensions.get("KHR_texture_transform")
        given = transform if isinstance(transform, dict) else {}
        return {**_UNMOVED, "texCoord": self.texCoord, **given} != _UNMOVED


class _GltfColours(msgspec.Struct, frozen=True):
    """The colour textures of either material model."""

    baseColorTexture: _GltfTexture | None = None
    diffuseTexture: _GltfTexture | None = None


class _GltfExtensions(msgspec.Struct, frozen=True):
    KHR_materials_pbrSpecularGlossiness: _GltfColours = _GltfColours()


class _GltfMaterial(msgspec.Struct):
    pbrMetallicRoughness: _GltfColours = _GltfColours()
    extensions: _GltfExtensions = _GltfExtensions()

    def is_moved(self) -> bool:
        colours = (self.pbrMetallicRoughness, self.extensions.KHR_materials_pbrSpecularGlossiness)
        textures = (each for one in colours for each in (one.baseColorTexture, one.diffuseTexture))
        return any(each is not None and each.is_moved() for each in textures)


class _Gltf(msgspec.Struct):
    accessors: Annotated[list[_Accessor], Meta(max_length=100_000)] = []
    meshes: Annotated[list[_GltfMesh], Meta(max_length=100_000)] = []
    nodes: Annotated[list[_Node], Meta(max_length=100_000)] = []
    materials: Annotated[list[_GltfMaterial], Meta(max_length=100_000)] = []
    extensionsRequired: Annotated[list[str], Meta(max_length=1000)] = []

    def numbers(self) -> int:
        """Counts what is read: every accessor once, and again for every part and node using it."""
        sizes = [each.count * _NUMBERS_EACH.get(each.type, 16) for each in self.accessors]
        shown = Counter(node.mesh for node in self.nodes)
        total = sum(sizes)
        for index, mesh in enumerate(self.meshes):
            for part in mesh.primitives:
                named = (*part.attributes.values(), part.indices)
                # trimesh refuses accessors that do not exist.
                own = sum(sizes[each] for each in named if each is not None and each < len(sizes))
                total += own * max(1, shown[index])
        return total


def refuse_misread(path: Path) -> None:
    """Refuses glTF that trimesh reads wrongly, and more numbers than memory holds."""
    content = path.read_bytes()
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    gltf: _Gltf = parse_document(
        content, _Gltf, str(path), "give an OBJ or GLB file", error=ConfigurationError
    )
    if gltf.numbers() > _MOST_NUMBERS:
        raise ConfigurationError(
            f"{path} unfolds to more than {_MOST_NUMBERS:,} numbers, too much for one vehicle; "
            "simplify it."
        )
    for extension in gltf.extensionsRequired:
        if extension in _COMPRESSIONS:
            raise ConfigurationError(
                f"{path} is compressed ({_COMPRESSIONS[extension]}), which is not decoded here; "
                "export it again without mesh compression."
            )
    used = {part.material for mesh in gltf.meshes for part in mesh.primitives}
    if any(material.is_moved() for place, material in enumerate(gltf.materials) if place in used):
        raise ConfigurationError(
            f"{path} moves a texture (KHR_texture_transform) or lays it by other UVs than "
            "TEXCOORD_0, which is not read here; bake that into its first UVs and export it again."
        )
