"""Finds points of photographs that can be recognised at any heading, scale and brightness."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.feature import SIFT

Complex = NDArray[np.complex128]
Numbers = NDArray[np.int64]
Picture = NDArray[np.float32]

SMALLEST_PX = 24
LEAST_CONTRAST = 0.004
LEAST_BLUR_PX = 1.1
"""Blur of the smallest points, at which a coarse picture still has enough of them."""
WINDOWS = {"lambda_ori": 1.2, "lambda_descr": 4.5}
"""Reach of a point's heading and descriptor, in its blurs: most of the time goes into them."""


@dataclass(frozen=True)
class Keypoints:
    """Points of a picture, x right and y down as complex numbers in pixels.

    Attributes:
        places: `[n]`.
        sizes: blur times e^(i heading), `[n]`.
        descriptors: unit vectors, `[n, 128]`.
    """

    places: Complex
    sizes: Complex
    descriptors: Picture


def find_keypoints(grey: Picture, usable: NDArray[np.bool_], most: int) -> Keypoints:
    """Finds the largest points of a picture `[H, W]`, at most so many, where it is usable.

    A point with several headings counts several times. Source: SIFT (Lowe 2004,
    https://doi.org/10.1023/B:VISI.0000029664.99615.94), with the square roots of Arandjelović and
    Zisserman (2012, https://doi.org/10.1109/CVPR.2012.6248018).
    """
    none = Keypoints(np.zeros(0, complex), np.zeros(0, complex), np.zeros((0, 128), np.float32))
    if min(grey.shape) < SMALLEST_PX:
        return none
    # Any, because its results are declared as None.
    finder: Any = SIFT(upsampling=1, sigma_min=LEAST_BLUR_PX, c_dog=LEAST_CONTRAST, **WINDOWS)
    try:
        finder.detect_and_extract(grey)
    except RuntimeError:
        # scikit-image raises this for a picture without any point.
        return none
    rows, columns = np.rint(finder.keypoints).astype(np.int64).T
    inside = usable[rows.clip(0, len(usable) - 1), columns.clip(0, usable.shape[1] - 1)]
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.argsort(-finder.sigmas[chosen], kind="stable")[:most]]
    down, right = finder.keypoints[chosen].T
    vectors = finder.descriptors[chosen].astype(np.float32)
    return Keypoints(
        right + 0.5 + 1j * (down + 0.5),
        finder.sigmas[chosen] * np.exp(1j * (math.pi / 2 - finder.orientations[chosen])),
        np.sqrt(vectors / (vectors.sum(1, keepdims=True) + 1e-12)),
    )
