"""Patterns that no training draws from: stripes, blobs, Perlin noise and lettering.

A detector that learnt the random controls of all textures has seen independent cells. These have
structure at every scale and angle, so they tell whether it learnt vehicles or those cells.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image, ImageDraw
from torch import Tensor

from skyproof.camouflage.paint import finished_paint
from skyproof.camouflage.texture import UniversalTexture
from skyproof.randomness import generator_of
from skyproof.vehicles.vehicle import TEXTURE_SIZE

_Colours = Int[np.ndarray, "512 512"]
"""The number of each texel's colour."""

_OCTAVES = 3
# Eight capital letters of 3 x 5 squares, row by row.
_LETTERS = tuple(
    np.array([*letter], int).reshape(5, 3)
    for letter in (
        *("010101111101101", "111100110100111", "101101111101101", "101101110101101"),
        *("100100100100111", "111010010010010", "101101010101101", "111001010100111"),
    )
)


def _stripes(rng: np.random.Generator, colours: int) -> _Colours:
    """Stripes of one width at any angle."""
    y, x = np.mgrid[:TEXTURE_SIZE, :TEXTURE_SIZE]
    angle_rad, width = rng.uniform(0, math.pi), _size(rng, 8.0, 64.0)
    across = x * math.cos(angle_rad) + y * math.sin(angle_rad)
    return np.asarray(np.floor(across / width).astype(int) % colours)


def _blobs(rng: np.random.Generator, colours: int) -> _Colours:
    """Ellipses of similar size, twice as many as would cover the map side by side."""
    picture = Image.new("L", (TEXTURE_SIZE, TEXTURE_SIZE))
    draw = ImageDraw.Draw(picture)
    radius = _size(rng, 12.0, 64.0)
    for _ in range(round(2 * TEXTURE_SIZE**2 / (math.pi * radius**2))):
        x, y = rng.uniform(0, TEXTURE_SIZE, 2)
        half_x, half_y = radius * np.exp(rng.normal(0, 0.4, 2))
        colour = int(rng.integers(colours))
        draw.ellipse((x - half_x, y - half_y, x + half_x, y + half_y), fill=colour)
    return np.asarray(picture).astype(int)


def _noise(rng: np.random.Generator, colours: int) -> _Colours:
    """Perlin noise of three octaves (Perlin 1985, fade of 2002), cut into equally large steps."""
    total = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE))
    cell = 2 ** int(rng.integers(5, 8))
    for octave in range(_OCTAVES):
        cells = TEXTURE_SIZE // cell
        angle_rad = rng.uniform(0, 2 * math.pi, (cells + 1, cells + 1))
        place = (np.arange(TEXTURE_SIZE) + 0.5) / cell
        index, inside = place.astype(int), place % 1
        fade = inside**3 * (inside * (inside * 6 - 15) + 10)
        for down in (0, 1):
            for right in (0, 1):
                here = angle_rad[np.ix_(index + down, index + right)]
                slope = np.cos(here) * (inside - right) + np.sin(here) * (inside - down)[:, None]
                weight = (fade if down else 1 - fade)[:, None] * (fade if right else 1 - fade)
                total += 0.5**octave * weight * slope
        cell //= 2
    order = total.ravel().argsort(kind="stable").argsort(kind="stable")
    return np.asarray((order * colours // order.size).reshape(total.shape))


def _lettering(rng: np.random.Generator, colours: int) -> _Colours:
    """Rows of capital letters in other colours than their ground."""
    square = round(_size(rng, 6.0, 24.0))
    side = TEXTURE_SIZE // square + 1
    map_ = np.zeros((side, side), int)
    for top in range(0, side - 4, 6):
        for left in range(int(rng.integers(4)), side - 2, 4):
            letter = _LETTERS[rng.integers(len(_LETTERS))]
            map_[top : top + 5, left : left + 3] = letter * rng.integers(1, colours)
    whole = map_.repeat(square, 0).repeat(square, 1)[:TEXTURE_SIZE, :TEXTURE_SIZE]
    return np.rot90(whole, int(rng.integers(4)))


def _size(rng: np.random.Generator, least: float, most: float) -> float:
    return math.exp(rng.uniform(math.log(least), math.log(most)))


_PATTERNS: dict[str, Callable[[np.random.Generator, int], _Colours]] = {
    "stripes": _stripes,
    "blobs": _blobs,
    "noise": _noise,
    "lettering": _lettering,
}
PATTERNS = tuple(_PATTERNS)
"""The kinds of pattern. A texel is about 1 cm wide (docs/vehicles.md)."""


def draw_pattern(
    kind: str, palette: Float[Tensor, "K 3"], *, seed: int, draw: int, masked: bool = False
) -> UniversalTexture:
    """Draws a pattern of `PATTERNS` over a vehicle or its panels, in a palette's sRGB colours.

    With the same seed, a precheck and the choice of a control have the same draws.
    """
    generator = generator_of(seed, "gate", kind, str(draw))
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    number = torch.from_numpy(_PATTERNS[kind](rng, len(palette)).copy())
    shuffled = palette[torch.from_numpy(rng.permutation(len(palette)))]
    drawn = shuffled[number].permute(2, 0, 1)
    return finished_paint(kind, drawn, masked=masked, repeat=str(draw))
