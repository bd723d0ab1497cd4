"""Maps of the shadows in photographs, so that a vehicle placed in one is in shadow.

A map has the size of its tile. A pixel of v says that shadows of the photograph take v / 255 of the
direct sun from the ground there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from skyproof.scenes.backgrounds import BackgroundSet, on_tile
from skyproof.scenes.footprints import Sizes, footprint
from skyproof.scenes.scene import BackgroundWindow, Placement

__all__ = ["shaded"]

_ALONG, _ACROSS = 9, 5
"""Points of a vehicle's footprint at which the map is read."""


def shaded(
    placements: Sequence[Placement],
    backgrounds: BackgroundSet,
    window: BackgroundWindow,
    vehicle_sizes_m: Sizes,
) -> tuple[Placement, ...]:
    """Returns vehicles with the part of the sun that the shadows they stand in take from them.

    The whole vehicle gets the mean over its footprint, although its roof may reach out of a
    shadow, and though a shadow's edge may cross it.

    Raises:
        StoredFileError: the tile's map is missing or damaged.
    """
    shade = backgrounds.shade(window.tile)
    if shade is None or not len(placements):
        return tuple(placements)
    along = (torch.arange(_ALONG, dtype=torch.float64) + 0.5) / _ALONG - 0.5
    across = (torch.arange(_ACROSS, dtype=torch.float64) + 0.5) / _ACROSS - 0.5
    along, across = (each.flatten() for each in torch.meshgrid(along, across, indexing="ij"))
    standing = []
    for placement in placements:
        x_m, y_m, heading_rad, length_m, width_m = footprint(placement, vehicle_sizes_m, 0.0)
        cosine = math.cos(heading_rad)
        sine = math.sin(heading_rad)
        east_m = x_m + cosine * length_m * along - sine * width_m * across
        north_m = y_m + sine * length_m * along + cosine * width_m * across
        column, row = on_tile(window, east_m / backgrounds.gsd_m, north_m / backgrounds.gsd_m)
        values = shade[
            row.floor().long().clamp(0, shade.shape[0] - 1),
            column.floor().long().clamp(0, shade.shape[1] - 1),
        ]
        standing.append(replace(placement, shade=round(float(values.double().mean()) / 255, 3)))
    return tuple(standing)
