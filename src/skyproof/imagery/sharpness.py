"""Measures blur and noise of photographs, on their own edges and plain places."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from skyproof.datasets.pictures import Pixels
from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.scenes.sensor import Sensor

EDGES_PER_IMAGE = 400
LEAST_EDGES = 100
LEAST_STEP = 0.08
"""In linear light: fainter edges drown in noise."""
SHARPEST_SHARE = 0.25
REACH_PX = 12
LARGEST_PX = 768
"""Only the middle of an image is measured, so that memory does not grow with it."""
STEP_PX = 0.25


def measure_sensor(images: Iterable[Pixels]) -> Sensor:
    """Measures blur and noise of photographs; the paper has one blur for all (section S2.1).

    Blur: light is read along the gradient across each of the strongest edges. A step behind a
    Gaussian blur rises at most by step / (σ √(2π)) per pixel. Edges in the world may be soft, but
    none is sharper than the sensor, so the lower quartile over all edges is taken.

    Noise: the spread of the difference from a 3 x 3 median, in cells of 8 x 8 pixels. The plainest
    cells count, so that texture is not taken for noise.
    """
    sigmas: list[NDArray[np.float64]] = []
    spreads: list[float] = []
    for whole in images:
        image = _middle(whole)
        grey = srgb_to_linear(image.double() / 255).mean(0).numpy()
        sigmas.append(_edge_blurs(grey))
        spreads.append(_noise(image.double().mean(0).numpy() / 255))
    blurs = np.concatenate(sigmas) if sigmas else np.zeros(0)
    if len(blurs) < LEAST_EDGES:
        raise ImageryError(
            f"Measuring the blur of imagery expects at least {LEAST_EDGES} clear edges but found "
            f"{len(blurs)}; give sharper or larger images."
        )
    return Sensor(
        blur_sigma_px=round(float(np.quantile(blurs, SHARPEST_SHARE)), 2),
        noise=round(float(np.median(spreads)), 4),
    )


def _middle(image: Pixels) -> UInt8[Tensor, "3 h w"]:
    top, left = (max(0, (side - LARGEST_PX) // 2) for side in image.shape[1:])
    return image[:, top : top + LARGEST_PX, left : left + LARGEST_PX]


def _edge_blurs(grey: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns σ in pixels at the strongest edges of one image."""
    # The strongest edges: local maxima of the slope, away from the border.
    across_x = ndimage.gaussian_filter(grey, 0.7, order=(0, 1))
    across_y = ndimage.gaussian_filter(grey, 0.7, order=(1, 0))
    strength = np.hypot(across_x, across_y)
    inner = np.zeros(grey.shape, bool)
    inner[REACH_PX + 2 : -REACH_PX - 2, REACH_PX + 2 : -REACH_PX - 2] = True
    rows, columns = np.nonzero(
        inner & (strength == ndimage.maximum_filter(strength, 5)) & (strength > 0)
    )
    order = np.argsort(-strength[rows, columns], kind="stable")[:EDGES_PER_IMAGE]
    rows, columns = rows[order], columns[order]
    # Brightness along three lines across each edge, so that no corner or speck counts as an edge.
    x = across_x[rows, columns] / strength[rows, columns]
    y = across_y[rows, columns] / strength[rows, columns]
    offsets = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    side = np.array([-1.0, 0.0, 1.0])[:, None, None]
    down = rows[:, None] + offsets * y[:, None] + side * x[:, None]
    right = columns[:, None] + offsets * x[:, None] - side * y[:, None]
    profile = ndimage.map_coordinates(grey, [down, right], order=3).mean(0)
    # The blur from height and steepness of the step, with a window that follows it.
    steepest = (np.diff(profile, axis=1) / STEP_PX).max(1)
    middle = profile.shape[1] // 2
    sigma = np.full(len(profile), 1.0)
    for _ in range(4):
        # The window ends with the edge, because something else lies beyond.
        width = np.clip(np.round(3 * sigma / STEP_PX), 6, middle).astype(int)
        step = np.array(
            [
                row[middle : middle + w + 1].max() - row[middle - w : middle + 1].min()
                for row, w in zip(profile, width, strict=True)
            ]
        )
        sigma = step / (np.maximum(steepest, 1e-9) * np.sqrt(2 * np.pi))
    return sigma[step > LEAST_STEP] if len(sigma) else sigma


def _noise(grey: NDArray[np.float64]) -> float:
    """Measures the standard deviation of one colour channel's noise, in sRGB units."""
    rest = grey - ndimage.median_filter(grey, 3)
    height, width = (side // 8 * 8 for side in grey.shape)
    cells = rest[:height, :width].reshape(height // 8, 8, width // 8, 8).std(axis=(1, 3)).ravel()
    return float(np.quantile(cells, 0.05))
