"""The cost of a camouflage on real vehicles: the paper's signs (section 4) and what is measured."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import label
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.name import TextureConstraints
from skyproof.camouflage.texture import UniversalTexture
from skyproof.geometry.meshes import enclosed_volume_m3, self_intersections
from skyproof.vehicles.texels import texel_metric, texel_regions
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, VehicleBatch

_CRITERIA = ("production_cost", "installation_difficulty", "operation_difficulty")
"""PC, DI and DO; +1 is practical, 0 neither, -1 impractical."""

_BLOCK_REGIONS = ("roof", "bonnet", "sides")

_Texture = Float[Tensor, "3 512 512"] | UInt8[Tensor, "3 512 512"]
_Masks = Bool[Tensor, "N 512 512"]


def score_practicality(texture: TextureConstraints | None, shape_changed: bool) -> dict[str, Any]:
    """Returns the signs by the paper's rules (section 4).

    - Installation is + with Pix, as blocks can be stuck on or painted one by one, otherwise −.
    - Operation is + with Ma, as windows, lights and wheels stay free, otherwise −.
    - Production is + with Pix and Fc, 0 with Pix and Lc (its colours may be hard to get), otherwise
      −: few colours alone save nothing, because the whole vehicle still has to be wrapped.
    - A changed shape is − in all three.

    An original side has 0; "total" is the sum of all signs.
    """
    signs = (0, 0, 0)
    if texture is not None:
        few = {"fixed": 1, "learnt": 0, "free": -1}[texture.colours]
        production, installation = (few, 1) if texture.pixelised else (-1, -1)
        signs = (production, installation, 1 if texture.masked else -1)
    shape = (-1, -1, -1) if shape_changed else (0, 0, 0)
    return {
        "texture": dict(zip(_CRITERIA, signs, strict=True)),
        "shape": dict(zip(_CRITERIA, shape, strict=True)),
        "total": sum(signs) + sum(shape),
    }


@torch.no_grad()
def practicality_account(camouflage: Camouflage, vehicles: VehicleBatch) -> dict[str, Any]:
    """Returns a camouflage's signs, and measured means over vehicles; None for unchanged sides."""
    parts = list(camouflage.modules())
    texture = next((part for part in parts if isinstance(part, UniversalTexture)), None)
    shapes = (part for part in parts if isinstance(part, DisplacementMap))
    shape = next((part for part in shapes if part.magnitude > 0), None)
    texture_means = shape_means = None
    if texture is not None:
        block_px = TEXTURE_SIZE // texture.blocks if texture.constraints.pixelised else None
        texture_means = mean_measures(
            measure_texture(vehicles, texture.bytes(), texture.mask(vehicles), block_px)
        )
    if shape is not None:
        rows = measure_shape(vehicles, shape(vehicles))
        crossing = sum(row["intersections_after"] > row["intersections_before"] for row in rows)
        shape_means = {**mean_measures(rows), "share_self_intersecting": crossing / len(rows)}
    constraints = texture.constraints if texture is not None else None
    return {
        "name": str(camouflage.name),
        "score": score_practicality(constraints, shape_changed=shape is not None),
        "texture": texture_means,
        "shape": shape_means,
    }


def measure_texture(
    vehicles: VehicleBatch, texture: _Texture, mask: _Masks | None, block_px: int | None
) -> list[dict[str, float]]:
    """Measures a universal texture (sRGB in [0, 1] or bytes) on each vehicle, in its present shape.

    Blocks of Pix have sides of `block_px` texels. Per vehicle "painted_area_m2" of the covered
    texels, their different 8-bit "colours", "boundary_m" of all edges between them, and "regions"
    of one colour, connected across edges. With Pix "blocks" that are covered, and their median size
    around the body (u) and along it (v), such as "block_roof_u_cm".
    """
    painted = worn_texels(vehicles, mask)
    colour, colours = _numbered_colours(texture)
    same_right = colour == colour.roll(-1, 1)
    same_below = colour[:-1] == colour[1:]
    length_u, length_v, area = texel_metric(vehicles)
    # A texel and its right neighbour, circular in u, meet along v; with the one below along u.
    edge_right = (length_v + length_v.roll(-1, 2)) / 2
    edge_below = (length_u[:, :-1] + length_u[:, 1:]) / 2
    regions = {} if block_px is None else texel_regions(vehicles)
    measures = []
    for i, inside in enumerate(painted):
        both_right = inside & inside.roll(-1, 1)
        both_below = inside[:-1] & inside[1:]
        across = edge_right[i][both_right & ~same_right].double().sum()
        along = edge_below[i][both_below & ~same_below].double().sum()
        row = {
            "painted_area_m2": float(area[i][inside].double().sum()),
            "colours": int((torch.bincount(colour[inside], minlength=colours) > 0).sum()),
            "boundary_m": float(across + along),
            "regions": _count_regions(torch.where(inside, colour + 1, 0)),
        }
        if block_px is not None:
            blocks = inside.unflatten(1, (-1, block_px)).unflatten(0, (-1, block_px))
            row["blocks"] = int(blocks.any(3).any(1).sum())
            for name in _BLOCK_REGIONS:
                region = regions[name][i]
                if region.any():
                    for axis, lengths in (("u", length_u), ("v", length_v)):
                        texel_m = float(lengths[i][region].median())
                        row[f"block_{name}_{axis}_cm"] = 100 * block_px * texel_m
        measures.append(row)
    return measures


@torch.no_grad()
def measure_shape(before: VehicleBatch, after: VehicleBatch) -> list[dict[str, float]]:
    """Measures every vehicle as built and deformed; the displacement is the largest of a vertex."""
    faces = before.template.faces
    volume, volume_after = (
        enclosed_volume_m3(batch.vertices, faces).tolist() for batch in (before, after)
    )
    moved = (after.vertices - before.vertices).norm(dim=-1).amax(dim=1).tolist()
    size, size_after = (
        batch.vertices.amax(dim=1) - batch.vertices.amin(dim=1) for batch in (before, after)
    )
    return [
        {
            "volume_m3": volume[row],
            "added_volume_m3": volume_after[row] - volume[row],
            "largest_displacement_m": moved[row],
            "added_length_m": length_m,
            "added_width_m": width_m,
            "added_height_m": height_m,
            "intersections_before": self_intersections(before.vertices[row], faces),
            "intersections_after": self_intersections(after.vertices[row], faces),
        }
        for row, (length_m, width_m, height_m) in enumerate((size_after - size).tolist())
    ]


def worn_texels(vehicles: VehicleBatch, mask: _Masks | None) -> _Masks:
    """The covered texels of each vehicle, on the CPU; without a mask all but the underside."""
    return (vehicles.parts != Part.UNDERSIDE if mask is None else mask).cpu()


def mean_measures(measures: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the vehicles that have a measure."""
    names = dict.fromkeys(name for row in measures for name in row)
    return {name: fmean(row[name] for row in measures if name in row) for name in names}


def _numbered_colours(texture: _Texture) -> tuple[Int[Tensor, "512 512"], int]:
    """Replaces each 8-bit colour of a texture by a number from 0 on, and counts the colours."""
    texture = texture.detach().cpu()
    if texture.dtype != torch.uint8:
        texture = (texture.clamp(0.0, 1.0) * 255).round()
    red, green, blue = texture.long()
    colours, numbered = torch.unique((red * 256 + green) * 256 + blue, return_inverse=True)
    return numbered, len(colours)


def _count_regions(colour: Int[Tensor, "512 512"]) -> int:
    """Counts connected areas of one colour, from 1 on, in a map that is circular in u."""
    labels, count = label(colour.numpy(), connectivity=1, return_num=True)
    # Areas that meet at the seam are tied together.
    seam = ((colour[:, -1] == colour[:, 0]) & (colour[:, 0] > 0)).numpy()
    ties = coo_array(
        (np.ones(seam.sum()), (labels[seam, -1] - 1, labels[seam, 0] - 1)), shape=(count, count)
    )
    return int(connected_components(ties, directed=False, return_labels=False)) if count else 0
