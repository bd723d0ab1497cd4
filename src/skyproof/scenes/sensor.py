"""The sensor of a photograph, or of a set of photographs (section S2.1)."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import Checked

PAPER_BLUR_SIGMA_PX = 2.4
"""The best blur for the paper's own imagery (figure S5)."""

Blur = Annotated[float, Meta(ge=0, le=10)]
Noise = Annotated[float, Meta(ge=0, le=0.5)]

BlurChoice = Blur | Literal["paper"]
"""A blur as users give it: a number of pixels, or the word for the paper's blur."""

_SHARPEST_PX = 0.01


@dataclass(frozen=True)
class Sensor(Checked):
    """Standard deviations of blur and of noise (sRGB units); the default is a sharp orthophoto."""

    blur_sigma_px: Blur = 0.7
    noise: Noise = 0.006

    @property
    def blur_radius_px(self) -> int:
        """Radius (k - 1) / 2 of the paper's kernel of k = 6 * ceil(sigma) - 1 pixels."""
        # A narrower kernel is one pixel, and would divide by nearly nothing.
        sharp = self.blur_sigma_px < _SHARPEST_PX
        return 0 if sharp else 3 * math.ceil(self.blur_sigma_px) - 1
