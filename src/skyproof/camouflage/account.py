"""What a camouflage asks of those who would make it: the paper's signs, and measured quantities."""

from dataclasses import asdict
from statistics import fmean
from typing import Any

import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.measures import mean_measures, measure_texture
from skyproof.camouflage.practicality import score_practicality
from skyproof.camouflage.shape_measures import measure_shape
from skyproof.camouflage.texture import UniversalTexture
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch


@torch.no_grad()
def practicality_account(camouflage: Camouflage, vehicles: VehicleBatch) -> dict[str, Any]:
    """Signs (section 4) and measured quantities of a finished camouflage, means over the vehicles.

    Returns:
        "name"; "score" with three signs each of texture and shape and their "total"; "texture" and
        "shape" with the means of `mean_measures` and `ShapeMeasures`, None for an unchanged side.
        The shape's "share_self_intersecting" is the share of vehicles with more intersections than
        as built.
    """
    texture, shape = _parts(camouflage)
    changed = shape is not None and shape.magnitude > 0
    score = score_practicality(texture.constraints if texture else None, shape_changed=changed)
    texture_means = None
    if texture is not None:
        block_px = TEXTURE_SIZE // texture.blocks if texture.constraints.pixelised else None
        texture_means = mean_measures(
            measure_texture(vehicles, texture.bytes(), texture.mask(vehicles), block_px)
        )
    shape_means = None
    if changed and shape is not None:
        rows = measure_shape(vehicles, shape(vehicles))
        names = [name for name, value in asdict(rows[0]).items() if not isinstance(value, str)]
        shape_means = {name: fmean(float(getattr(row, name)) for row in rows) for name in names}
        shape_means["share_self_intersecting"] = fmean(
            row.intersections_after > row.intersections_before for row in rows
        )
    return {
        "name": str(camouflage.name),
        "score": {
            "texture": asdict(score.texture),
            "shape": asdict(score.shape),
            "total": score.total,
        },
        "texture": texture_means,
        "shape": shape_means,
    }


def _parts(camouflage: Camouflage) -> tuple[UniversalTexture | None, DisplacementMap | None]:
    if isinstance(camouflage, Combination):
        return camouflage.texture, camouflage.shape
    return (
        camouflage if isinstance(camouflage, UniversalTexture) else None,
        camouflage if isinstance(camouflage, DisplacementMap) else None,
    )
