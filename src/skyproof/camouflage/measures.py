"""What a texture would take on real vehicles: painted area, blocks, colours, boundaries."""

from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.vehicles.texels import texel_metric, texel_regions
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, VehicleBatch

_BLOCK_REGIONS = ("roof", "bonnet", "sides")
_PLAIN = ("painted_area_m2", "colours", "boundary_m", "regions")


@dataclass(frozen=True)
class TextureMeasures:
    """One texture on one vehicle.

    Attributes:
        painted_area_m2: area of the covered texels.
        colours: different 8-bit colours among them.
        boundary_m: length of all edges between covered texels of different colour.
        regions: connected areas of one colour, across edges, not corners.
        blocks: blocks of Pix with a covered texel; None without Pix.
        block_cm: median size of a block by region, such as {"roof": (15.8, 18.1)}, around the body
            (u) and along it (v); empty without Pix.
    """

    painted_area_m2: float
    colours: int
    boundary_m: float
    regions: int
    blocks: int | None
    block_cm: dict[str, tuple[float, float]]


def measure_texture(
    vehicles: VehicleBatch,
    texture: Float[Tensor, "3 512 512"] | UInt8[Tensor, "3 512 512"],
    mask: Bool[Tensor, "N 512 512"] | None,
    block_px: int | None,
) -> tuple[TextureMeasures, ...]:
    """Measures a universal texture on each vehicle, in its present shape.

    Args:
        texture: the map, sRGB in [0, 1] or bytes; colours are compared as bytes.
        mask: cover on each vehicle; None for everything but the underside.
        block_px: side of a block of Pix in texels; None without Pix.

    Raises:
        ConfigurationError: blocks that do not fit the map a whole number of times.
    """
    if block_px is not None and (block_px < 1 or TEXTURE_SIZE % block_px):
        raise ConfigurationError(
            f"Blocks of {block_px} texels do not divide a map of {TEXTURE_SIZE}; give a divisor."
        )
    painted = worn_texels(vehicles, mask)
    colour, colours = _numbered_colours(texture)
    same_right = colour == colour.roll(-1, 1)
    same_below = colour[:-1] == colour[1:]
    length_u, length_v, area = texel_metric(vehicles)
    # A texel and its right neighbour, circular in u, meet along v; with the one below along u.
    edge_right = (length_v + length_v.roll(-1, 2)) / 2
    edge_below = (length_u[:, :-1] + length_u[:, 1:]) / 2
    block_sizes = (
        [{}] * len(vehicles)
        if block_px is None
        else _block_sizes(vehicles, length_u, length_v, block_px)
    )

    measures = []
    for i, inside in enumerate(painted):
        both_right = inside & inside.roll(-1, 1)
        both_below = inside[:-1] & inside[1:]
        across = edge_right[i][both_right & ~same_right].double().sum()
        along = edge_below[i][both_below & ~same_below].double().sum()
        measures.append(
            TextureMeasures(
                painted_area_m2=float(area[i][inside].double().sum()),
                colours=int((torch.bincount(colour[inside], minlength=colours) > 0).sum()),
                boundary_m=float(across + along),
                regions=_count_regions(inside, both_right & same_right, both_below & same_below),
                blocks=None if block_px is None else _count_blocks(inside, block_px),
                block_cm=block_sizes[i],
            )
        )
    return tuple(measures)


def worn_texels(
    vehicles: VehicleBatch, mask: Bool[Tensor, "N 512 512"] | None
) -> Bool[Tensor, "N 512 512"]:
    """The covered texels of each vehicle, on the CPU; without a mask all but the underside."""
    return (vehicles.parts != Part.UNDERSIDE if mask is None else mask).cpu()


def mean_measures(measures: tuple[TextureMeasures, ...]) -> dict[str, float]:
    """Means over vehicles, under flat names such as "painted_area_m2" and "block_roof_u_cm".

    A block's size in a region is the mean over the vehicles that have the region.
    """
    columns: dict[str, list[float]] = {}
    for measure in measures:
        row: dict[str, float] = {name: getattr(measure, name) for name in _PLAIN}
        if measure.blocks is not None:
            row["blocks"] = measure.blocks
        for region, (u_cm, v_cm) in measure.block_cm.items():
            row |= {f"block_{region}_u_cm": u_cm, f"block_{region}_v_cm": v_cm}
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    return {name: fmean(values) for name, values in columns.items()}


def _numbered_colours(
    texture: Float[Tensor, "3 512 512"] | UInt8[Tensor, "3 512 512"],
) -> tuple[Int[Tensor, "512 512"], int]:
    """Replaces each 8-bit colour of a texture by a number from 0 on, and counts the colours."""
    texture = texture.detach().cpu()
    if texture.dtype != torch.uint8:
        texture = (texture.clamp(0.0, 1.0) * 255).round()
    red, green, blue = texture.long()
    colours, numbered = torch.unique((red * 256 + green) * 256 + blue, return_inverse=True)
    return numbered, len(colours)


def _block_sizes(
    vehicles: VehicleBatch,
    length_u: Float[Tensor, "N 512 512"],
    length_v: Float[Tensor, "N 512 512"],
    block_px: int,
) -> list[dict[str, tuple[float, float]]]:
    """Per vehicle and region: median texel times texels per block, in centimetres."""
    sizes: list[dict[str, tuple[float, float]]] = [{} for _ in range(len(vehicles))]
    regions = texel_regions(vehicles)
    for name in _BLOCK_REGIONS:
        for i, inside in enumerate(regions[name]):
            if inside.any():
                u_m, v_m = (float(lengths[i][inside].median()) for lengths in (length_u, length_v))
                sizes[i][name] = (100 * block_px * u_m, 100 * block_px * v_m)
    return sizes


def _count_blocks(worn: Bool[Tensor, "512 512"], block_px: int) -> int:
    blocks = worn.unflatten(1, (-1, block_px)).unflatten(0, (-1, block_px))
    return int(blocks.any(3).any(1).sum())


def _count_regions(
    worn: Bool[Tensor, "512 512"],
    joined_right: Bool[Tensor, "512 512"],
    joined_below: Bool[Tensor, "511 512"],
) -> int:
    """Counts connected areas, in a picture twice as large that alternates texels and joints."""
    picture = np.zeros((2 * TEXTURE_SIZE - 1, 2 * TEXTURE_SIZE), dtype=bool)
    picture[::2, ::2] = worn.numpy()
    picture[::2, 1::2] = joined_right.numpy()
    picture[1::2, ::2] = joined_below.numpy()
    labels, count = ndimage.label(picture)
    # The last column holds the joints across the seam: they tie labels there to the first column.
    seam = picture[:, -1]
    ties = coo_array(
        (np.ones(seam.sum()), (labels[seam, -1] - 1, labels[seam, 0] - 1)), shape=(count, count)
    )
    return int(connected_components(ties, directed=False, return_labels=False)) if count else 0
