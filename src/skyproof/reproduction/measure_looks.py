"""What the textures of a run look like in numbers: their colours, and how alike repeats are."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.measures import worn_texels
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError
from skyproof.geometry.colour import linear_to_srgb, srgb_to_cielab, srgb_to_linear
from skyproof.vehicles.texels import texel_metric
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch


def measure_looks(
    folders: Sequence[Path],
    vehicles: VehicleBatch,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measures textures on the vehicles that wear them, each texel by its area there.

    Args:
        folders: of camouflages. Those that are no textures are passed over; repeats of one texture
            are compared with each other, and as many draws of its control.
        vehicles: procedural vehicles on the template of `make_template`.
        progress: called with (folders done, folders in all).

    Returns:
        "textures" with a row of `ColourCounts` each; "pairs" with a row for every two repeats:
        "correlation" and "distance" of `Likeness`, and the same as "seen_...", coarsely.

    Raises:
        StoredFileError: a folder is damaged.
    """
    compared = _compared([folder.name for folder in folders])
    # Where textures are worn depends on their mask alone.
    areas: dict[bool, Float[Tensor, "512 512"]] = {}
    worn: dict[str, tuple[Worn, Worn]] = {}
    rows = []
    for done, folder in enumerate(folders, 1):
        texture = load_camouflage(folder)
        if isinstance(texture, UniversalTexture):
            masked = texture.constraints.masked
            if masked not in areas:
                areas[masked] = worn_area(vehicles, texture.mask(vehicles))
            counts = count_colours(texture.bytes(), areas[masked])
            rows.append({"name": folder.name, **asdict(counts)})
            if folder.name in compared:
                fine = Worn.of(texture.bytes(), areas[masked])
                worn[folder.name] = (fine, fine.seen())
        if progress:
            progress(done, len(folders))
    pairs = [
        _pair(worn, first, second)
        for first, second in itertools.combinations(worn, 2)
        if compared[first] == compared[second]
    ]
    return {"textures": rows, "pairs": pairs}


def _compared(names: Sequence[str]) -> dict[str, CamouflageName]:
    """Says of which texture a name is a repeat: for learnt ones, and as many draws of each."""
    pooled = {name: CamouflageName.read(name).pooled for name in names}
    learnt = Counter(of for of in pooled.values() if not of.random)
    most: Counter[CamouflageName] = Counter()
    for of, repeats in learnt.items():
        most[of.control] = max(most[of.control], repeats)
    kept: dict[str, CamouflageName] = {}
    for name, of in pooled.items():
        if not of.random or list(kept.values()).count(of) < most[of]:
            kept[name] = of
    return kept


def _pair(worn: dict[str, tuple[Worn, Worn]], first: str, second: str) -> dict[str, Any]:
    fine, seen = map(likeness, worn[first], worn[second])
    coarsely = {f"seen_{key}": value for key, value in asdict(seen).items()}
    return {"first": first, "second": second, **asdict(fine), **coarsely}


SEEN_TEXELS = 4
"""Side in texels of the blocks that the renderer reads most: five samples in eight see the mean of
4 x 4 texels (docs/conventions.md)."""


@dataclass(frozen=True)
class Worn:
    """A texture's colours and how much each counts.

    Attributes:
        colours: `[3, H, W]` sRGB in [0, 1].
        area: `[H, W]` of each on the vehicles that wear it.
    """

    colours: Float[Tensor, "3 H W"]
    area: Float[Tensor, "H W"]

    @classmethod
    def of(cls, texture: UInt8[Tensor, "3 H W"], area: Float[Tensor, "H W"]) -> Worn:
        """Takes a texture of 8 bits."""
        return cls(texture.float() / 255, area)

    def seen(self) -> Worn:
        """Averages over blocks of `SEEN_TEXELS`, in linear light, as the renderer does."""
        total = _summed(self.area)
        light = _summed(srgb_to_linear(self.colours) * self.area)
        return Worn(linear_to_srgb(light / total.clamp(min=1e-12)), total)


@dataclass(frozen=True)
class Likeness:
    """How alike two textures are on the vehicles that wear them.

    Attributes:
        correlation: of the two textures' values, per channel about its mean, mean over the
            channels; None where one channel of either is the same everywhere. 0 is expected of
            textures that have nothing to do with each other.
        distance: mean distance of the two colours in CIELAB (CIE 1976). 2.3 can just be noticed
            (Mahy and others 1994).
    """

    correlation: float | None
    distance: float


def likeness(first: Worn, second: Worn) -> Likeness:
    """Compares two textures of one size, each texel by the area that both cover."""
    area = torch.minimum(first.area, second.area).double().flatten()
    shares = area / area.sum()

    # Correlation of each channel.
    one, other = (worn.colours.double().flatten(1) for worn in (first, second))
    one = one - (one @ shares)[:, None]
    other = other - (other @ shares)[:, None]
    spread = ((one**2 @ shares) * (other**2 @ shares)).sqrt()
    known = bool((spread > 1e-9).all())
    products = ((one * other) @ shares / spread).clamp(-1.0, 1.0)
    correlation = float(products.mean()) if known else None

    # Distance of the colours.
    cielab = [srgb_to_cielab(worn.colours.flatten(1).T) for worn in (first, second)]
    distance = float((cielab[0] - cielab[1]).norm(dim=-1).double() @ shares)
    return Likeness(correlation, distance)


def _summed(values: Float[Tensor, "*C H W"]) -> Float[Tensor, "*C h w"]:
    return values.unflatten(-1, (-1, SEEN_TEXELS)).unflatten(-3, (-1, SEEN_TEXELS)).sum((-3, -1))


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
