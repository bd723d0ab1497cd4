"""A vehicle: vertices on the shared template, a texture and part labels."""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

TEXTURE_SIZE = 512


class Part(IntEnum):
    """Labels of the part map; a masked camouflage paints `BODY` alone (section S4.2.2)."""

    BODY = 0
    GLASS = 1
    LIGHT = 2
    WHEEL = 3
    BUMPER = 4
    TRIM = 5
    UNDERSIDE = 6


@dataclass(frozen=True)
class Template:
    """The closed mesh that every vehicle shares (sections 3.1 and S4.3), with poles at the bumpers.

    Attributes:
        faces: `[F, 3]` vertex indices, counter-clockwise from outside; seam vertices share one
            index.
        face_uvs: `[F, 3]` indices into `uvs`.
        uvs: `[U, 2]` in [0, 1]; u runs around the long axis and is circular, v from nose (0) to
            tail (1). Texel centre of column i, row j: ((i + 0.5) / 512, (j + 0.5) / 512).
        mirror: `[V]` the vertex of the reflection y -> -y; an involution.
        vertex_uvs: `[V, 2]` the topology map (section S4.3), where each vertex reads a map.
    """

    faces: Int[Tensor, "F 3"]
    face_uvs: Int[Tensor, "F 3"]
    uvs: Float[Tensor, "U 2"]
    mirror: Int[Tensor, " V"]
    vertex_uvs: Float[Tensor, "V 2"]

    def to(self, device: torch.device | str) -> "Template":
        """Returns the copy on a device, always the same one, by whose faces buffers know it."""
        return _template_on(self, torch.device(device))


@lru_cache(maxsize=8)
def _template_on(template: Template, device: torch.device) -> Template:
    return Template(*(getattr(template, name).to(device) for name in Template.__dataclass_fields__))


@dataclass(frozen=True)
class Overlay:
    """One texture over the vehicles' own, where their mask is set (equation 2)."""

    texture: Float[Tensor, "3 512 512"]
    mask: Bool[Tensor, "N 512 512"]


@dataclass(frozen=True)
class VehicleBatch:
    """Some vehicles on one template.

    Vehicle frame: x forward, y left, z up, metres, ground at z = 0 under the centre.

    Attributes:
        vertices: `[N, V, 3]` metres.
        texture: `[N or 1, 3, 512, 512]` sRGB, bytes or in [0, 1]; 1 is one map shared by all.
            Without an overlay the map may be coarser.
        parts: `[N, 512, 512]` values of `Part`.
        ids: N names, such as "saloon-0017": body type, hyphen, number.
        overlay: a common texture on top of `texture`, or none.
        repainted: whether `texture` is a camouflage's instead of the vehicles' own.
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

    def to(self, device: torch.device | str) -> "VehicleBatch":
        """Returns the same vehicles on another device."""
        over = self.overlay
        return replace(
            self,
            template=self.template.to(device),
            vertices=self.vertices.to(device),
            texture=self.texture.to(device),
            parts=self.parts.to(device),
            overlay=over and Overlay(over.texture.to(device), over.mask.to(device)),
        )

    def row(self, index: int) -> "VehicleBatch":
        """Returns one vehicle as a batch of its own."""
        single = slice(index, index + 1)
        over = self.overlay
        return replace(
            self,
            vertices=self.vertices[single],
            texture=self.texture if len(self.texture) == 1 else self.texture[single],
            parts=self.parts[single],
            ids=self.ids[single],
            overlay=over and Overlay(over.texture, over.mask[single]),
        )

    def worn_texture(self) -> Float[Tensor, "T 3 M M"] | UInt8[Tensor, "T 3 M M"]:
        """Returns the visible textures, the overlay included."""
        if self.overlay is None:
            return self.texture
        texture = self.texture.float() / 255 if self.texture.dtype == torch.uint8 else self.texture
        return torch.where(self.overlay.mask[:, None], self.overlay.texture, texture)
