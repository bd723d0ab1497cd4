"""What each part of a vehicle is made of, for a path tracer."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.vehicles.vehicle import Part, VehicleBatch

__all__ = ["CAMOUFLAGE", "material_labels", "material_table"]

CAMOUFLAGE = len(Part)
"""Label of texels that a camouflage covers, beside the parts' own."""

# Roughness, clear coat, specular level (0.5 is a refractive index of 1.5), roughness of the coat.
# Our estimates: a coat in daily use is neither polished nor dull. Vehicles are closed shells:
# windows are dark mirrors, as from above.
_FINISHES = {
    Part.BODY: (0.6, 1.0, 0.0, 0.12),
    Part.GLASS: (0.03, 0.0, 0.5, 0.0),
    Part.LIGHT: (0.2, 1.0, 0.5, 0.05),
    Part.WHEEL: (0.85, 0.0, 0.25, 0.0),
    Part.BUMPER: (0.6, 0.7, 0.2, 0.2),
    Part.TRIM: (0.6, 0.0, 0.4, 0.0),
    Part.UNDERSIDE: (0.9, 0.0, 0.2, 0.0),
}
_CAMOUFLAGE = {"gloss": _FINISHES[Part.BODY], "matt": (0.9, 0.0, 0.2, 0.0)}


def material_table(finish: str) -> Float[Tensor, "8 4"]:
    """Returns the finish of each label, as Blender's Principled BSDF has it.

    It is roughness, clear coat, specular level and the coat's roughness.

    Args:
        finish: of camouflage: "gloss", under the same clear coat as paint, or "matt".
    """
    return torch.tensor([_FINISHES[part] for part in Part] + [_CAMOUFLAGE[finish]])


def material_labels(vehicles: VehicleBatch) -> UInt8[Tensor, "N 512 512"]:
    """Returns each texel's part, or `CAMOUFLAGE` where it is covered: paint on glass is paint."""
    covered = vehicles.covered_texels()
    return vehicles.parts if covered is None else vehicles.parts.masked_fill(covered, CAMOUFLAGE)
