"""The practicality of a camouflage: the paper's signs (section 4), and measured quantities."""

from typing import Any

import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.measures import mean_measures, measure_shape, measure_texture
from skyproof.camouflage.texture import UniversalTexture
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch

_CRITERIA = ("production_cost", "installation_difficulty", "operation_difficulty")
"""PC, DI and DO; +1 is practical, 0 neither, -1 impractical."""


def score_practicality(texture: TextureConstraints | None, shape_changed: bool) -> dict[str, Any]:
    """The paper's rules (section 4).

    - Installation is + with Pix, as blocks can be stuck on or painted one by one, otherwise −.
    - Operation is + with Ma, as windows, lights and wheels stay free, otherwise −.
    - Production is + with Pix and Fc, 0 with Pix and Lc (its colours may be hard to get), otherwise
      −: few colours alone save nothing, because the whole vehicle still has to be wrapped.
    - A changed shape is − in all three.

    Returns:
        The signs of "texture" and "shape", 0 for an original side, and their sum as "total".
    """
    signs = (0, 0, 0)
    if texture is not None:
        production = {"fixed": 1, "learnt": 0, "free": -1}[texture.colours]
        signs = (
            production if texture.pixelised else -1,
            1 if texture.pixelised else -1,
            1 if texture.masked else -1,
        )
    shape = (-1, -1, -1) if shape_changed else (0, 0, 0)
    return {
        "texture": dict(zip(_CRITERIA, signs, strict=True)),
        "shape": dict(zip(_CRITERIA, shape, strict=True)),
        "total": sum(signs) + sum(shape),
    }


@torch.no_grad()
def practicality_account(camouflage: Camouflage, vehicles: VehicleBatch) -> dict[str, Any]:
    """Signs and measured quantities of a finished camouflage, means over the vehicles.

    Returns:
        "name"; "score" as returned by `score_practicality`; "texture" and "shape" with the means of
        `measure_texture` and `measure_shape`, None for an unchanged side. The shape's
        "share_self_intersecting" is the share of vehicles with more intersections than as built.
    """
    parts = [camouflage]
    if isinstance(camouflage, Combination):
        parts = [camouflage.texture, camouflage.shape]
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
