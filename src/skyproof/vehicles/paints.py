"""Draws the colour of a vehicle's paint: published frequencies and a little variation."""

import torch
from jaxtyping import Float
from torch import Tensor

DARKEST, LIGHTEST = 0.03, 0.97
"""Nothing paints blacker or whiter, sRGB."""

# Axalta Global Automotive Color Popularity Report 2022 (press release of 15 December 2022), share
# of cars built worldwide: white 34 %, black 21, grey 19, blue 8, red 5, green 1; "white, black,
# grey and silver" 82 together, which leaves silver 8. The remaining 4 % are not itemised there; we
# share them between brown or beige and yellow or orange.
PAINT_SHARES: dict[str, float] = {
    "white": 0.34,
    "black": 0.21,
    "grey": 0.19,
    "silver": 0.08,
    "blue": 0.08,
    "red": 0.05,
    "green": 0.01,
    "brown": 0.03,
    "yellow": 0.01,
}
_WHITE_VANS = 0.7  # our estimate, not published; the rest follows the table

# Typical diffuse sRGB of each colour space: our estimates, not measured.
PAINT_TONES: dict[str, list[tuple[float, float, float]]] = {
    "white": [(0.94, 0.94, 0.93), (0.91, 0.92, 0.92), (0.92, 0.91, 0.88)],
    "black": [(0.07, 0.07, 0.08), (0.10, 0.10, 0.11), (0.07, 0.08, 0.12)],
    "grey": [(0.30, 0.31, 0.33), (0.40, 0.41, 0.42), (0.23, 0.24, 0.26)],
    "silver": [(0.66, 0.67, 0.69), (0.72, 0.73, 0.74), (0.60, 0.62, 0.64)],
    "blue": [(0.10, 0.21, 0.46), (0.08, 0.13, 0.27), (0.27, 0.42, 0.60), (0.05, 0.28, 0.58)],
    "red": [(0.58, 0.06, 0.07), (0.43, 0.06, 0.09), (0.68, 0.11, 0.08)],
    "green": [(0.11, 0.26, 0.17), (0.30, 0.36, 0.26)],
    "brown": [(0.33, 0.24, 0.18), (0.64, 0.57, 0.47), (0.45, 0.38, 0.31)],
    "yellow": [(0.86, 0.66, 0.11), (0.80, 0.34, 0.08)],
}


def sample_paint(body_type: str, *, generator: torch.Generator) -> tuple[str, Float[Tensor, " 3"]]:
    """Draws a colour name and its sRGB in [0, 1]."""
    draws = torch.rand(3, generator=generator)
    shares = torch.tensor(list(PAINT_SHARES.values()))
    name = list(PAINT_SHARES)[
        min(int((draws[0] * shares.sum() > shares.cumsum(0)).sum()), len(shares) - 1)
    ]
    if body_type == "van" and float(draws[1]) < _WHITE_VANS:
        name = "white"
    tones = PAINT_TONES[name]
    tone = torch.tensor(tones[min(int(draws[2] * len(tones)), len(tones) - 1)])
    lightness = 1 + 0.08 * torch.randn(1, generator=generator)
    tint = 0.006 * torch.randn(3, generator=generator)
    return name, (tone * lightness + tint).clamp(DARKEST, LIGHTEST)
