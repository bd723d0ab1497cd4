"""Where in the RGB cube the colours of a texture lie: at its faces, edges, corners, or inside."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from skyproof.camouflage.measures import worn_texels
from skyproof.errors import ConfigurationError
from skyproof.vehicles.texels import texel_metric
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch

BINS = 16
"""Of a channel's histogram. A channel is at an end in the first and the last of them: within a
sixteenth of its range."""

_VALUES = 256 // BINS


@dataclass(frozen=True)
class ColourCounts:
    """Shares of a texture's area by where its colours lie in the RGB cube (section S7).

    Colours drawn uniformly from [0, 1], and then rounded to 8 bits, have 32.2 % at the faces, 4.1 %
    at the edges and 0.2 % at the corners.

    Attributes:
        faces: with one channel or more at an end.
        edges: with two or more.
        corners: with all three: black, white, and the six full colours.
        histogram: red, green and blue, each with the shares of its `BINS` bins from dark to bright.
    """

    faces: float
    edges: float
    corners: float
    histogram: tuple[tuple[float, ...], ...]


def count_colours(
    colours: UInt8[Tensor, "3 ..."], area: Float[Tensor, ...] | None = None
) -> ColourCounts:
    """Counts colours of 8 bits by where they lie in the RGB cube.

    Args:
        colours: sRGB.
        area: what each counts; None counts all alike.

    Raises:
        ConfigurationError: nothing counts.
    """
    bins = colours.flatten(1).long() // _VALUES
    weights = torch.ones_like(bins[0]) if area is None else area.flatten()
    weights = weights.double()
    whole = float(weights.sum())
    if whole <= 0:
        raise ConfigurationError(
            "Counting colours expects an area above 0, got none; give vehicles that wear them."
        )
    shares = weights / whole
    channels = ((bins == 0) | (bins == BINS - 1)).sum(0)
    # Sums of many shares may be a little above one.
    faces, edges, corners = (
        min(float(shares[channels >= least].sum()), 1.0) for least in (1, 2, 3)
    )
    return ColourCounts(
        faces,
        edges,
        corners,
        tuple(
            tuple(torch.bincount(channel, weights=shares, minlength=BINS).clamp(max=1.0).tolist())
            for channel in bins
        ),
    )


def worn_area(
    vehicles: VehicleBatch, mask: Bool[Tensor, "N 512 512"] | None
) -> Float[Tensor, "512 512"]:
    """Gives the square metres of each texel that wear a texture, mean over the vehicles.

    Args:
        vehicles: procedural vehicles on the template of `make_template`.
        mask: where the texture is laid; None for everywhere but the underside.
    """
    worn = worn_texels(vehicles, mask)
    total = torch.zeros(TEXTURE_SIZE, TEXTURE_SIZE)
    # One by one: the maps of a whole fleet take gigabytes.
    for index, texels in enumerate(worn):
        _, _, area = texel_metric(vehicles.row(index))
        total += area[0].masked_fill(~texels, 0.0)
    return total / len(worn)
