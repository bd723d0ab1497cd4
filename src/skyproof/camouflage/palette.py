"""Few colours that stand for many: K-means over the pixels of the ground, in CIELAB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import read_json
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.randomness import generator_of
from skyproof.scenes.backgrounds import BackgroundSet

__all__ = ["fit_palette", "ground_palette", "load_palette"]

_PIXELS_PER_TILE = 4000


def fit_palette(
    pixels: Float[Tensor, "P 3"], colours: int = 5, *, seed: int
) -> Float[Tensor, "K 3"]:
    """Few colours that stand for many pixels, by K-means in CIELAB (section 5.4).

    In CIELAB equal distances look about equally different, so that dark ground does not lose its
    colours to bright ground. The best of four seeded starts is taken.

    Differences from the paper: it names no colour space.

    Args:
        pixels: sRGB in [0, 1].
        colours: how many.
        seed: of the starts.

    Returns:
        sRGB in [0, 1], rounded to 8 bits, the most frequent colour first.

    Raises:
        ConfigurationError: fewer than two colours are asked for, or the pixels have fewer distinct
            ones.
    """
    if colours < 2:
        raise ConfigurationError(
            f"A palette expects at least 2 colours, got {colours}; give more colours."
        )
    distinct = len(torch.unique((pixels * 255).round(), dim=0))
    if distinct < colours:
        raise ConfigurationError(
            f"A palette of {colours} colours needs ground with as many, but its pixels have "
            f"{distinct}; give other imagery or fewer colours."
        )
    # Slow to import, and needed by one command.
    from sklearn.cluster import KMeans

    points = srgb_to_cielab(pixels.double()).numpy()
    means = KMeans(colours, n_init=4, random_state=seed).fit(points)
    order = np.argsort(-np.bincount(means.labels_, minlength=colours), kind="stable")
    centres = cielab_to_srgb(torch.from_numpy(means.cluster_centers_[order]))
    return ((centres * 255).round() / 255).float()


def ground_palette(
    backgrounds: BackgroundSet, colours: int = 5, *, seed: int = 0
) -> Float[Tensor, "K 3"]:
    """The colours of the ground that attacks see, evenly from all of its tiles (section 5.4).

    Args:
        backgrounds: the pixels of their split "attack" are looked at.
        colours: how many.
        seed: of the choice of pixels and of the starts of K-means.

    Returns:
        sRGB in [0, 1], rounded to 8 bits, the most frequent colour first.

    Raises:
        ConfigurationError: fewer than two colours are asked for, or the ground has fewer.
        StoredFileError: a tile is missing or damaged.
    """
    generator = generator_of(seed, "palette")
    pixels = backgrounds.sample_pixels("attack", _PIXELS_PER_TILE, generator=generator)
    return fit_palette(pixels, colours, seed=seed)


def load_palette(path: Path) -> Float[Tensor, "K 3"]:
    """Reads `[K, 3]` colours from JSON: {"colours_srgb": [[red, green, blue], ...]}, 0 to 255.

    Raises:
        ConfigurationError: fewer than two colours.
        StoredFileError: the file is missing or of another form.
    """
    document = read_json(Path(path))
    rows = document.get("colours_srgb") if isinstance(document, dict) else None
    whole = isinstance(rows, list) and all(
        isinstance(row, list)
        and len(row) == 3
        and all(isinstance(v, int) and 0 <= v <= 255 for v in row)
        for row in rows
    )
    if not whole:
        raise StoredFileError(
            f'{path} is not a palette; expected {{"colours_srgb": [[red, green, blue], ...]}} with '
            "whole numbers 0 to 255."
        )
    assert isinstance(rows, list)
    if len(rows) < 2:
        raise ConfigurationError(
            f"A palette expects at least 2 colours, but {path} has {len(rows)}; give more colours."
        )
    return torch.tensor(rows).float() / 255
