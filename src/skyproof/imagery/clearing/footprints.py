"""Measures the shade of the ground below labelled vehicles in pictures, and the vehicles' paint."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from skimage.filters import threshold_otsu
from torch import Tensor

from skyproof.datasets.pictures import Pixels, window_around
from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import RemovedVehicle

SHADED_BELOW = 0.4
"""Brightness of ground in the shade, as a share of that under sunlit vehicles of the tile. The sky
gives a quarter of the light, so shade lies at 0.25, and dark asphalt beside light at half."""
SUNLIT_SHARE = 0.75
FILM, CLEAR_COAT, SLOPES = 0.015, 0.02, 0.9
"""What dust adds and what clear coat mirrors of the sky, both as shares of white, and the share of
paint that slopes leave. On renders of known paint at three places, the median error is −3 to 4 of
255 sRGB levels, but −12 for white at one place."""
_DARKEST, _LIGHTEST = 0.0023, 0.93


def sunlit(
    image: Pixels, places: Sequence[RemovedVehicle], gsd_m: float
) -> tuple[RemovedVehicle, ...]:
    """Returns the places outside the shade on a cleared picture, as no render fits shaded ones."""
    grounds = [_light(image, place, gsd_m, 1.0, 1.0) for place in places]
    known = [ground.mean() for ground in grounds if len(ground)]
    least = SHADED_BELOW * np.quantile(known, SUNLIT_SHARE) if known else 0.0
    return tuple(
        place
        for place, ground in zip(places, grounds, strict=True)
        if not len(ground) or ground.mean() >= least
    )


def worn_paints(tiles: BackgroundSet, cleared: BackgroundSet) -> Float[Tensor, "n 3"]:
    """Estimates the paint of each vehicle of known heading that was removed from tiles, in sRGB.

    The light of the cleared tile turns pixels into reflectances. Panes are darker than light paint
    and brighter than dark paint, so the larger of two groups of pixels (Otsu's threshold, 1979)
    shows the paint.
    """
    paints = []
    for tile in cleared.all_tiles():
        light, image = tile.light or cleared.light, tiles.pixels(tile.id)
        black, white = np.array(light.black), np.array(light.white)
        for place in tile.removed:
            shown = _light(image, place, cleared.gsd_m, 0.85, 0.7)
            if not len(shown):
                continue
            lightness = np.cbrt(shown.mean(1)).round(6)  # else rounding errors make two groups
            light_group = lightness > threshold_otsu(lightness)
            body = np.median(shown[light_group == (light_group.mean() > 0.5)], axis=0)
            reflected = (body - black) / np.maximum(white - black, 0.05)
            paint = (reflected - FILM - CLEAR_COAT * np.array(light.sky)) / SLOPES
            paints.append(np.clip(paint, _DARKEST, _LIGHTEST))
    return linear_to_srgb(torch.tensor(np.array(paints).reshape(-1, 3), dtype=torch.float32))


def _light(
    image: Pixels, place: RemovedVehicle, gsd_m: float, along: float, across: float
) -> NDArray[np.float64]:
    """Returns the linear pixels of a share of a vehicle's rectangle, `[n, 3]`."""
    if place.heading_rad is None or place.length_m is None or place.width_m is None:
        return np.zeros((0, 3))
    middle = (place.x_px, place.y_px, place.x_px, place.y_px)
    near = window_around(middle, place.length_m / gsd_m, image.shape[1:])
    part = image[:, *near]
    rows, columns = np.mgrid[near] + 0.5
    x, y = columns - place.x_px, rows - place.y_px
    cosine, sine = np.cos(place.heading_rad), np.sin(place.heading_rad)
    inside = np.abs(cosine * x - sine * y) < along * place.length_m / gsd_m / 2
    inside &= np.abs(sine * x + cosine * y) < across * place.width_m / gsd_m / 2
    pixels: NDArray[np.float64] = srgb_to_linear(part.double() / 255).numpy()[:, inside].T
    return pixels
