"""Brings a mesh file onto the shared template: vertices, texture, parts, and how well it fits."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.pictures import decoded, open_picture
from skyproof.vehicles.wrapping.baking import bake, to_bytes
from skyproof.vehicles.wrapping.meshes import SourceMesh
from skyproof.vehicles.wrapping.orientation import orient
from skyproof.vehicles.wrapping.outer import look_around
from skyproof.vehicles.wrapping.parts import PLAIN_COLOURS, label_parts
from skyproof.vehicles.wrapping.quality import measure_wrapping
from skyproof.vehicles.wrapping.reading import read_mesh
from skyproof.vehicles.wrapping.surface import wrap_surface

_ALPHA_SHARE = 0.02


@dataclass(frozen=True)
class WrappedVehicle:
    """One mesh on the template.

    Attributes:
        report: orientation, fit (`measure_wrapping`), labels, and notes on repairs.
    """

    mesh: SourceMesh
    vertices: Float[Tensor, "994 3"]
    texture: UInt8[Tensor, "3 512 512"]
    parts: UInt8[Tensor, "512 512"]
    report: dict[str, Any]


def wrap_mesh(
    path: Path,
    *,
    scale: float | None = None,
    up: str | None = None,
    forward: str | None = None,
    paintable: Path | None = None,
) -> WrappedVehicle:
    """Wraps one mesh file.

    Args:
        scale, up, forward: as in `orient`.
        paintable: picture on the mesh's own UVs, bright for paint; the default is the textures'
            alpha, if it varies.

    Raises:
        ConfigurationError: unreadable, no triangles, not a vehicle's size, or axes that do not fit.
    """
    mask = None if paintable is None else _read_mask(paintable)
    mesh, facts = orient(read_mesh(path), scale=scale, up=up, forward=forward)
    notes = list(mesh.notes)
    outer = look_around(mesh.corners)
    if outer.inverted:
        notes.append(
            f"{outer.inverted} of {outer.seen} visible triangles face inwards; they were turned "
            "round."
        )
    if not any(m.picture is not None for m in mesh.materials) and np.isnan(mesh.colours).any():
        notes.append("no texture: plain colours of materials or parts are used.")
    wrapping = wrap_surface(mesh.corners)
    texels = bake(mesh, outer, wrapping, mask)
    clear = float((texels.alpha < 0.5).mean())
    masked = mask is not None or _ALPHA_SHARE < clear < 1 - _ALPHA_SHARE
    if masked and mask is None:
        notes.append("the texture's alpha is taken as a mask of what is paint.")
    plain = np.array([m.plain for m in mesh.materials])[mesh.material[texels.face]]
    plain &= np.isnan(mesh.colours[texels.face, 0, 0])
    if plain.any() and any(m.picture is not None for m in mesh.materials):
        notes.append(
            f"{plain.mean():.0%} of the surface have no colour in the file: plain colours of parts "
            "are used."
        )
    parts, shares, doubts = label_parts(mesh, texels, wrapping, plain, masked=masked)
    colour = np.where(
        plain[..., None], np.array(list(PLAIN_COLOURS.values()))[parts], texels.colour
    )
    low = wrapping.vertices.amin(0)
    high = wrapping.vertices.amax(0)
    report = {
        "mesh": str(path),
        "triangles": len(mesh.corners),
        **facts,
        "size_m": [round(value, 3) for value in (high - low).tolist()],
        **measure_wrapping(mesh.corners, outer, wrapping),
        "parts_by": shares,
        "notes": notes + doubts,
    }
    return WrappedVehicle(
        replace(mesh, notes=tuple(notes)),
        wrapping.vertices,
        to_bytes(colour),
        torch.from_numpy(parts),
        report,
    )


def _read_mask(path: Path) -> UInt8[np.ndarray, "H W"]:
    remedy = "give a PNG mask with --wrapping.paintable"
    with open_picture(path, remedy, error=ConfigurationError, also=("TGA", "GIF")) as image:
        return decoded(image, "L", str(path), remedy, error=ConfigurationError, also=("TGA", "GIF"))
