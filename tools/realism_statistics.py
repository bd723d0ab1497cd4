"""What can be said of vehicles in numbers, real and rendered side by side, for tools/realism.py.

Where a vehicle's pixels lie is known of rendered ones alone, so the same places serve for both: the
*middle*, a disc of 0.8 m around the middle of the box, which lies on the vehicle whatever its
heading; the *box*; and the *ring* of ground around it, 0.4 to 1.4 m outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from realism_crops import Crop

Array = NDArray[np.float64]

_MIDDLE_M = 0.8
_RING_M = (0.4, 1.4)
_LUMINANCE = np.array([0.299, 0.587, 0.114])


def statistics(crops: Sequence[Crop], gsd_m: float) -> dict[str, Array]:
    """Measures every window.

    Args:
        crops: windows around vehicles.
        gsd_m: metres per pixel.

    Returns:
        Per statistic `[N]` its values, in grey levels where the name says nothing else.
    """
    rows = [_of_one(crop, gsd_m) for crop in crops]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def compare(
    values: dict[str, Array],
    rendered: NDArray[np.bool_],
    spot_of: NDArray[np.int64],
    area: Callable[[Array], dict[str, float]],
) -> dict[str, dict[str, object]]:
    """Puts real and rendered values side by side.

    Args:
        values: from `statistics`.
        rendered: `[N]` which windows are rendered.
        spot_of: `[N]` each window's spot, whose windows count as one by their mean.
        area: gives the AUC of telling them by one value.

    Returns:
        Per statistic its 10th, 50th and 90th percentile over spots, and its AUC: above 0.5 where
        rendered vehicles have more of it.
    """
    return {
        name: {
            "real": _percentiles(own[~rendered], spot_of[~rendered]),
            "rendered": _percentiles(own[rendered], spot_of[rendered]),
            "auc": area(own),
        }
        for name, own in values.items()
    }


def _percentiles(values: Array, spot_of: NDArray[np.int64]) -> list[float]:
    means = [values[spot_of == spot].mean() for spot in np.unique(spot_of)]
    return [round(float(value), 4) for value in np.percentile(means, (10, 50, 90))]


def _of_one(crop: Crop, gsd_m: float) -> dict[str, float]:
    pixels = crop.pixels.numpy().astype(np.float64)
    luminance = np.tensordot(_LUMINANCE, pixels, 1)
    left, top, right, bottom = crop.box
    steps = np.arange(pixels.shape[1]) + 0.5
    # How far every pixel is from the box's middle, and outside of the box.
    x, y = np.meshgrid(steps, steps)
    radius = np.hypot(x - (left + right) / 2, y - (top + bottom) / 2)
    outside = np.hypot(
        np.maximum(np.maximum(left - x, x - right), 0),
        np.maximum(np.maximum(top - y, y - bottom), 0),
    )
    middle = radius <= _MIDDLE_M / gsd_m
    box = outside == 0
    ring = (outside >= _RING_M[0] / gsd_m) & (outside <= _RING_M[1] / gsd_m)
    red, green, blue = pixels[:, middle].mean(1)
    saturation = (pixels.max(0) - pixels.min(0))[middle].mean()
    across = np.diff(luminance, axis=1)[:-1]
    down = np.diff(luminance, axis=0)[:, :-1]
    slope = np.zeros_like(luminance)
    slope[:-1, :-1] = np.hypot(across, down)
    # What neither a plane nor an edge explains: noise and the finest texture.
    fine = np.zeros_like(luminance)
    fine[1:-1, 1:-1] = (
        luminance[1:-1, 1:-1]
        - (luminance[1:-1, :-2] + luminance[1:-1, 2:]) / 2
        - (luminance[:-2, 1:-1] + luminance[2:, 1:-1]) / 2
        + (luminance[:-2, :-2] + luminance[:-2, 2:] + luminance[2:, :-2] + luminance[2:, 2:]) / 4
    )
    typical_ring = np.median(luminance[ring])
    sides_m = sorted(((right - left) * gsd_m, (bottom - top) * gsd_m))
    return {
        "middle, red": red,
        "middle, green": green,
        "middle, blue": blue,
        "middle, red - blue": red - blue,
        "middle, saturation (max - min)": saturation,
        "middle, p1": np.percentile(luminance[middle], 1),
        "middle, p50": np.percentile(luminance[middle], 50),
        "middle, p99": np.percentile(luminance[middle], 99),
        "middle, spread": luminance[middle].std(),
        "middle, fine texture": np.median(np.abs(fine[middle])),
        "middle - ring": luminance[middle].mean() - typical_ring,
        "middle - ring, absolute": abs(luminance[middle].mean() - typical_ring),
        "box, p1": np.percentile(luminance[box], 1),
        "box, p50": np.percentile(luminance[box], 50),
        "box, p99": np.percentile(luminance[box], 99),
        "box, share of pixels >= 250 (%)": 100 * (luminance[box] >= 250).mean(),
        "box, spread": luminance[box].std(),
        "box, mean slope": slope[box].mean(),
        "box, p95 of slope": np.percentile(slope[box], 95),
        "box, fine texture": np.median(np.abs(fine[box])),
        "ring, p5 - median": np.percentile(luminance[ring], 5) - typical_ring,
        "ring, p50": typical_ring,
        "ring, fine texture": np.median(np.abs(fine[ring])),
        "label, shorter side (m)": sides_m[0],
        "label, longer side (m)": sides_m[1],
    }
