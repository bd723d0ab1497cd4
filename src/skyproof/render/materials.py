"""What each part of a vehicle is made of: one table for both renderers."""

from functools import cache

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.vehicles.vehicle import Part, VehicleBatch

CAMOUFLAGE = len(Part)
"""Label of texels that a camouflage covers, beside the parts' own."""

# Black paint, rubber, and glass with seats behind it are not perfectly black: they reflect some
# light, through a film of dust. Without it the darkest parts of rendered vehicles were darker than
# those of photographed ones (docs/results/reality).
_DARKEST = 0.015

# Roughness, clear coat, specular level (0.5 is a refractive index of 1.5), the coat's roughness: as
# in Blender's Principled BSDF. Our estimates. The sun in a polished coat is a point that
# photographs hardly show. On our smooth bodies its image would be a white blob. Coats are therefore
# broad and weak, as dents, flakes and dust make a panel: a sheen that follows its curvature.
# Vehicles are closed shells: windows are nearly black and mirror the sky.
_FINISHES = {
    Part.BODY: (0.6, 0.45, 0.0, 0.4),
    Part.GLASS: (0.38, 0.0, 0.6, 0.0),
    Part.LIGHT: (0.2, 1.0, 0.5, 0.3),
    Part.WHEEL: (0.85, 0.0, 0.25, 0.0),
    Part.BUMPER: (0.6, 0.45, 0.2, 0.4),
    Part.TRIM: (0.6, 0.0, 0.4, 0.0),
    Part.UNDERSIDE: (0.9, 0.0, 0.2, 0.0),
}
_CAMOUFLAGE = {"gloss": _FINISHES[Part.BODY], "matt": (0.9, 0.0, 0.2, 0.0)}

# Reflectance of a refractive index of 1.5 at normal incidence.
_REFLECTANCE = 0.04
# A sharper lobe than this falls between the samples of one pixel.
_SHARPEST_EXPONENT = 1500.0


def reflectance(texture: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Returns the reflectance of a surface, camouflaged or not, by its texture in linear light."""
    return _DARKEST + (1 - _DARKEST) * texture


def material_table(finish: str = "gloss") -> Float[Tensor, "8 4"]:
    """Returns each label's columns of `_FINISHES`; camouflage has the finish "gloss" or "matt"."""
    return torch.tensor([_FINISHES[part] for part in Part] + [_CAMOUFLAGE[finish]])


@cache
def gloss_table(share: float = 1.0, device: torch.device | None = None) -> Float[Tensor, "8 2"]:
    """Returns each label's reflectance at normal incidence (times `share`), and glint's exponent.

    The exponent is that of a Blinn-Phong lobe as wide as the microfacet distribution of the same
    roughness r, 2 / r^4 - 2 (Walter et al. 2007), at most as sharp as samples can show.
    """
    rows = []
    for rough, coat, specular, coat_rough in material_table().tolist():
        reflectance = share * _REFLECTANCE * max(coat, specular / 0.5)
        exponent = 2 / (coat_rough if coat else rough) ** 4 - 2
        rows.append((reflectance, min(max(exponent, 1.0), _SHARPEST_EXPONENT)))
    return torch.tensor(rows, device=device)


def material_labels(vehicles: VehicleBatch) -> UInt8[Tensor, "N 512 512"]:
    """Returns each texel's part, or `CAMOUFLAGE` where it is covered: paint on glass is paint."""
    if vehicles.repainted:
        return torch.full_like(vehicles.parts, CAMOUFLAGE)
    over = vehicles.overlay
    return vehicles.parts if over is None else vehicles.parts.masked_fill(over.mask, CAMOUFLAGE)
