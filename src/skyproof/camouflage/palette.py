"""Palettes: a few colours that represent the ground, by K-means over its pixels in CIELAB."""

import math
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.randomness import generator_of
from skyproof.scenes.backgrounds import BackgroundSet

_PIXELS_PER_TILE = 4000
_PIXELS = 400_000
"""Rough number from all tiles: more change no colour, and country-wide ground has many tiles."""

_Byte = Annotated[int, Meta(ge=0, le=255)]


class _Palette(msgspec.Struct):
    """A palette file; whatever else a user keeps in it is ignored."""

    colours_srgb: Annotated[list[tuple[_Byte, _Byte, _Byte]], Meta(min_length=2, max_length=256)]


def fit_palette(pixels: Float[Tensor, "P 3"], colours: int) -> Float[Tensor, "K 3"]:
    """Finds 8-bit colours by K-means in CIELAB (section 5.4), the most frequent first."""
    distinct = len(torch.unique((pixels * 255).round(), dim=0))
    if distinct < colours:
        raise ConfigurationError(
            f"A palette of {colours} colours needs ground with as many, but its pixels have "
            f"{distinct}; give other imagery or fewer colours."
        )
    # Slow to import, and needed by one command.
    from sklearn.cluster import KMeans

    points = srgb_to_cielab(pixels.double()).numpy()
    means = KMeans(colours, n_init=4, random_state=0).fit(points)
    order = np.argsort(-np.bincount(means.labels_, minlength=colours), kind="stable")
    centres = cielab_to_srgb(torch.from_numpy(means.cluster_centers_[order]))
    return ((centres * 255).round() / 255).float()


def ground_palette(backgrounds: BackgroundSet, colours: int = 5) -> Float[Tensor, "K 3"]:
    """Fits a palette to the ground of attacks, with equally many pixels from each of its tiles."""
    tiles = max(1, len(backgrounds.tiles("attack")))
    per_tile = min(_PIXELS_PER_TILE, math.ceil(_PIXELS / tiles))
    pixels = backgrounds.sample_pixels("attack", per_tile, generator=generator_of(0, "palette"))
    return fit_palette(pixels, colours)


def load_palette(path: Path) -> Float[Tensor, "K 3"]:
    """Reads `[K, 3]` colours from JSON: {"colours_srgb": [[red, green, blue], ...]}, 0 to 255."""
    palette: _Palette = read_document(
        Path(path),
        _Palette,
        'give {"colours_srgb": [[red, green, blue], ...]} with 2 to 256 colours of whole numbers '
        "0 to 255",
    )
    return torch.tensor(palette.colours_srgb).float() / 255
