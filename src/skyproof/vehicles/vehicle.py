"""Says what a vehicle is: vertices on the shared template, a texture and part labels."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

TEXTURE_SIZE = 512


class Part(IntEnum):
    """Labels of the part map.

    Paint is `BODY`; nothing else may be painted by a masked camouflage (section S4.2.2).
    """

    BODY = 0
    GLASS = 1
    LIGHT = 2
    WHEEL = 3
    BUMPER = 4
    TRIM = 5
    UNDERSIDE = 6


@dataclass(frozen=True)
class Template:
    """The closed mesh that every vehicle shares (sections 3.1 and S4.3), a sphere in topology.

    Its poles lie at the two bumpers.

    Attributes:
        faces: `[F, 3]` vertex indices, counter-clockwise seen from outside; UV seam vertices share
            one index here.
        face_uvs: `[F, 3]` indices into `uvs`.
        uvs: `[U, 2]` in [0, 1]; u runs around the long axis and is circular, v from nose (0) to
            tail (1). Texel centre of column i, row j: u = (i + 0.5) / 512, v = (j + 0.5) / 512 (row
            0 at the nose).
        mirror: `[V]` the vertex that the reflection y -> -y takes each vertex to; an involution.
        vertex_uvs: `[V, 2]` the topology map (section S4.3): where each vertex reads a map in
            UV space.
    """

    faces: Int[Tensor, "F 3"]
    face_uvs: Int[Tensor, "F 3"]
    uvs: Float[Tensor, "U 2"]
    mirror: Int[Tensor, " V"]
    vertex_uvs: Float[Tensor, "V 2"]

    def to(self, device: torch.device | str) -> Template:
        """Returns the same template on another device, and the same copy every time.

        Buffers of geometry and edges are known by the tensor of the faces.
        """
        return _template_on(self, torch.device(device))


@lru_cache(maxsize=8)
def _template_on(template: Template, device: torch.device) -> Template:
    return Template(*(getattr(template, name).to(device) for name in Template.__dataclass_fields__))


@dataclass(frozen=True)
class Overlay:
    """One texture that hides the vehicles' own where each vehicle's mask is true (equation 2).

    Kept apart from them: a renderer then needs no full map in floats for every vehicle.

    Attributes:
        texture: `[3, 512, 512]` sRGB in [0, 1].
        mask: `[N, 512, 512]`.
    """

    texture: Float[Tensor, "3 512 512"]
    mask: Bool[Tensor, "N 512 512"]


@dataclass(frozen=True)
class VehicleBatch:
    """Some vehicles on one template.

    Vehicle frame: x forward, y left, z up, metres, ground at z = 0 under the centre.

    Attributes:
        template: the shared mesh.
        vertices: `[N, V, 3]` metres.
        texture: `[N or 1, 3, 512, 512]` sRGB, as bytes or in [0, 1]; a first dimension of 1 is one
            map shared by all. Without an overlay the map may be coarser.
        parts: `[N, 512, 512]` values of `Part`.
        ids: N names, e.g. "saloon-0017"; the body type is what stands before the last hyphen.
        overlay: a common texture on top of `texture`, or none.
        repainted: whether `texture` is a camouflage's and no longer the vehicles' own.
    """

    template: Template
    vertices: Float[Tensor, "N V 3"]
    texture: Float[Tensor, "T 3 M M"] | UInt8[Tensor, "T 3 M M"]
    parts: UInt8[Tensor, "N 512 512"]
    ids: tuple[str, ...]
    overlay: Overlay | None = None
    repainted: bool = False

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, device: torch.device | str) -> VehicleBatch:
        """Returns the same vehicles on another device."""
        over = self.overlay
        return VehicleBatch(
            self.template.to(device),
            self.vertices.to(device),
            self.texture.to(device),
            self.parts.to(device),
            self.ids,
            over and Overlay(over.texture.to(device), over.mask.to(device)),
            self.repainted,
        )

    def row(self, index: int) -> VehicleBatch:
        """Returns one vehicle as a batch of its own."""
        single = slice(index, index + 1)
        over = self.overlay
        return VehicleBatch(
            self.template,
            self.vertices[single],
            self.texture if len(self.texture) == 1 else self.texture[single],
            self.parts[single],
            self.ids[single],
            over and Overlay(over.texture, over.mask[single]),
            self.repainted,
        )

    def covered_texels(self) -> Bool[Tensor, "N 512 512"] | None:
        """Masks where a camouflage covers the vehicles; None for nowhere."""
        if self.repainted:
            return torch.ones_like(self.parts, dtype=torch.bool)
        return None if self.overlay is None else self.overlay.mask

    def worn_texture(self) -> Float[Tensor, "T 3 M M"] | UInt8[Tensor, "T 3 M M"]:
        """Returns the textures as they are seen, the overlay included.

        `[N or 1, 3, 512, 512]`: one map where it is shared.
        """
        if self.overlay is None:
            return self.texture
        texture = self.texture.float() / 255 if self.texture.dtype == torch.uint8 else self.texture
        return torch.where(self.overlay.mask[:, None], self.overlay.texture, texture)
