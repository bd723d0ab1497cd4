"""Reads COLLADA (.dae): triangles and polygons with their materials; no animation, no skin."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np
from jaxtyping import Float, UInt8

from skyproof.errors import ConfigurationError
from skyproof.vehicles.wrapping.meshes import (
    GREY,
    Material,
    Size,
    SourceMesh,
    find_texture,
    open_texture,
)

# As COLLADA weighs the colours of `transparent`.
_LUMINANCE = (0.212671, 0.715160, 0.072169)


class _Document:
    """The file's elements without their namespace, and by id."""

    def __init__(self, path: Path) -> None:
        self.path = path
        content = path.read_bytes()
        _refuse_entities(path, content)
        self.root = ElementTree.fromstring(content)
        for element in self.root.iter():
            element.tag = element.tag.rpartition("}")[2]
        self.by_id = {name: element for element in self.root.iter() if (name := element.get("id"))}
        self.notes: list[str] = []
        self.size = Size(path)
        self._pictures: dict[Path, UInt8[np.ndarray, "H W C"]] = {}

    def picture(self, path: Path) -> UInt8[np.ndarray, "H W C"]:
        """Returns a texture, decoded once however many materials show it."""
        if path not in self._pictures:
            self._pictures[path] = open_texture(path)
            self.size.add(texels=self._pictures[path].shape[0] * self._pictures[path].shape[1])
        return self._pictures[path]

    def linked(self, reference: str | None) -> Element | None:
        return self.by_id.get((reference or "").removeprefix("#"))

    def numbers(self, reference: str | None) -> Float[np.ndarray, "K D"]:
        """Returns the rows of a source."""
        source = self.linked(reference)
        array, accessor = (
            (None, None)
            if source is None
            else (source.find("float_array"), source.find(".//accessor"))
        )
        if array is None or accessor is None:
            raise ConfigurationError(
                f"{self.path} names the source {str(reference)[:200]}, which it does not hold; "
                "export it again."
            )
        return np.array((array.text or "").split(), float).reshape(
            -1, int(accessor.get("stride", "1"))
        )


def read_collada(path: Path) -> SourceMesh:
    """Reads every geometry that the file's scene shows.

    trimesh needs another package for this format.

    Raises:
        ConfigurationError: no triangles.
        xml.etree.ElementTree.ParseError, ValueError: damaged.
    """
    document = _Document(path)
    materials: list[Material] = []
    pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    scene = document.linked(
        getattr(document.root.find("scene/instance_visual_scene"), "attrib", {}).get("url")
    )
    for node in [] if scene is None else scene.findall("node"):
        _walk(document, node, np.eye(4), materials, pieces)
    if not pieces:
        raise ConfigurationError(f"{path} holds no triangles; give a mesh with faces.")
    if len(pieces) > 1:
        document.notes.append(f"{len(pieces)} objects were joined.")
    unit = document.root.find("asset/unit")
    up = getattr(document.root.find("asset/up_axis"), "text", None) or "Y_UP"
    corners, uvs, material = (np.concatenate(part) for part in zip(*pieces, strict=True))
    return SourceMesh(
        corners,
        uvs,
        np.full(corners.shape, np.nan),
        material,
        tuple(materials),
        up=up.strip()[0].lower(),
        unit_m=float(unit.get("meter", "1")) if unit is not None else 1.0,
        notes=tuple(dict.fromkeys(document.notes)),
    )


def _refuse_entities(path: Path, content: bytes) -> None:
    """Refuses a file that declares entities: a few lines of them unfold to any size.

    Raises:
        ConfigurationError: it does.
        xml.parsers.expat.ExpatError: it is no XML.
    """

    def refuse(*_: object) -> None:
        raise ConfigurationError(
            f"{path} declares XML entities, which no COLLADA file needs; export it again."
        )

    def stop(*_: object) -> None:
        # Declarations stand before the first element.
        raise StopIteration

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = stop
    with suppress(StopIteration):
        parser.Parse(content, True)


def _walk(
    document: _Document, node: Element, above: np.ndarray, materials: list[Material], pieces: list
) -> None:
    document.size.add(nodes=1)
    transform = above @ _transform(node)
    for instance in node.findall("instance_geometry"):
        geometry = document.linked(instance.get("url"))
        bound = {i.get("symbol"): i.get("target") for i in instance.iter("instance_material")}
        for kind in ("triangles", "polylist", "polygons"):
            for group in [] if geometry is None else geometry.findall(f"mesh/{kind}"):
                name = (
                    f"{geometry.get('name', '')} {node.get('name', '')}"
                    if geometry is not None
                    else ""
                )
                corners, uvs = _triangles(document, group)
                if not len(corners):
                    continue
                corners = corners @ transform[:3, :3].T + transform[:3, 3]
                symbol = group.get("material")
                materials.append(
                    _material(document, bound.get(symbol, f"#{symbol}"), name, symbol or "")
                )
                pieces.append((corners, uvs, np.full(len(corners), len(materials) - 1)))
    for child in node.findall("node"):
        _walk(document, child, transform, materials, pieces)
    for instance in node.findall("instance_node"):
        if (linked := document.linked(instance.get("url"))) is not None:
            _walk(document, linked, transform, materials, pieces)


def _transform(node: Element) -> Float[np.ndarray, "4 4"]:
    """Multiplies a node's transformations, in the order in which they are written."""
    out = np.eye(4)
    for element in node:
        if element.tag not in ("matrix", "translate", "scale", "rotate"):
            continue
        values = np.array((element.text or "").split(), float)
        step = np.eye(4)
        if element.tag == "matrix":
            step = values.reshape(4, 4)
        elif element.tag == "translate":
            step[:3, 3] = values
        elif element.tag == "scale":
            step[:3, :3] = np.diag(values)
        else:
            x, y, z = values[:3] / np.linalg.norm(values[:3])
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            angle = np.radians(values[3])
            step[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        out = out @ step
    return out


def _triangles(
    document: _Document, group: Element
) -> tuple[Float[np.ndarray, "F 3 3"], Float[np.ndarray, "F 3 2"]]:
    """Returns corners and UVs of one group; polygons are cut into fans."""
    inputs = {i.get("semantic"): i for i in reversed(group.findall("input"))}
    stride = 1 + max(int(i.get("offset", "0")) for i in group.findall("input"))
    lists = [
        np.array((p.text or "").split(), np.int64).reshape(-1, stride) for p in group.findall("p")
    ]
    if group.tag == "triangles":
        fans = [index.reshape(-1, 3, stride) for index in lists]
    else:
        if group.tag == "polylist" and lists:
            counts = np.array((group.findtext("vcount") or "").split(), np.int64)
            lists = np.split(lists[0], counts.cumsum()[:-1])
        fans = [
            np.stack([np.repeat(p[:1], len(p) - 2, 0), p[1:-1], p[2:]], axis=1)
            for p in lists
            if len(p) > 2
        ]
    if not fans:
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 2))
    index = np.concatenate(fans)
    document.size.add(triangles=len(index))
    vertices = document.linked(inputs["VERTEX"].get("source"))
    position = None if vertices is None else vertices.find("input[@semantic='POSITION']")
    points = document.numbers(None if position is None else position.get("source"))
    corners = points[index[..., int(inputs["VERTEX"].get("offset", "0"))], :3]
    uvs = np.zeros((*corners.shape[:2], 2))
    if (texture := inputs.get("TEXCOORD")) is not None:
        uvs = document.numbers(texture.get("source"))[
            index[..., int(texture.get("offset", "0"))], :2
        ]
    return corners, uvs


def _material(document: _Document, target: str | None, name: str, symbol: str) -> Material:
    """Follows a material to its colour or texture: effect, sampler, surface and image."""
    material = document.linked(target)
    name = f"{name} {symbol} {'' if material is None else material.get('name', '')}".strip()
    instance = None if material is None else material.find("instance_effect")
    effect = None if instance is None else document.linked(instance.get("url"))
    diffuse = None if effect is None else effect.find(".//diffuse")
    if effect is None or diffuse is None:
        return Material(name, plain=True)
    if (texture := diffuse.find("texture")) is not None:
        file = _picture_name(document, effect, texture.get("texture", ""))
        path = find_texture(document.path, file)
        if path is None:
            document.notes.append(
                f"texture {file} was not found beside {document.path}; a plain colour was taken."
            )
            return Material(name, plain=True)
        if path != document.path.parent / file:
            document.notes.append(f"{file} was not there; {path} was taken.")
        return Material(name, picture=document.picture(path), opacity=_opacity(effect))
    colour = np.array((diffuse.findtext("color") or "").split(), float)
    if len(colour) < 3:
        return Material(name, GREY, plain=True)
    r, g, b = colour[:3].clip(0.0, 1.0).tolist()
    return Material(name, (r, g, b), opacity=_opacity(effect))


def _opacity(effect: Element) -> float:
    """Returns the opacity of an effect; of a texture, which may be in its place, only its factor.

    By alpha (A_ONE, as where nothing is said) or luminance, of which one or zero is opaque.
    """
    transparent = effect.find(".//transparent")
    if transparent is None:
        return 1.0
    mode = transparent.get("opaque", "A_ONE")
    rgba = np.array((transparent.findtext("color") or "").split(), float)
    if len(rgba) < 3:
        rgba = np.zeros(4) if mode.endswith("ZERO") else np.ones(4)
    amount = float(rgba[:3] @ _LUMINANCE) if mode.startswith("RGB") else float([*rgba, 1.0][3])
    amount *= float(effect.findtext(".//transparency/float") or 1.0)
    return min(max(1 - amount if mode.endswith("ZERO") else amount, 0.0), 1.0)


def _picture_name(document: _Document, effect: Element, name: str) -> str:
    """Goes from a sampler's name to the file's; exporters also name the image itself."""
    for kind in ("sampler2D/source", "surface/init_from"):
        for parameter in effect.iter("newparam"):
            if parameter.get("sid") == name and (found := parameter.findtext(kind)):
                name = found.strip()
                break
    image = document.linked(name)
    return (
        name
        if image is None
        else (image.findtext("init_from") or image.findtext(".//ref") or name).strip()
    )
