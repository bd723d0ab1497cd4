"""How a photograph shows light: exposure and haze, the sky's share of the light, and the sun."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, SupportsFloat

from msgspec import Meta

from skyproof.ranges import Checked, Fraction, Radians
from skyproof.scenes.scene import Sun, SunElevation

CLEAR_SKY = (0.206, 0.253, 0.351)
"""The sky's share of the light on level ground: a quarter, in a clear sky's colour, linear sRGB.

The diffuse share of the global irradiance is 0.15 to 0.3 under a clear sky (Iqbal 1983). The colour
is that of daylight of 10,000 K on the CIE daylight locus (CIE 15), where white is the whole
daylight of 6,504 K: 0.824, 1.012 and 1.403 at luminance 1.
"""

_Level = Annotated[float, Meta(ge=0.05, le=20)]
_Deviation = Annotated[float, Meta(ge=0, le=3.2)]


@dataclass(frozen=True)
class SunEstimate(Checked):
    """The sun's position in the tile's axes, from x (right) towards y (up), with its errors."""

    azimuth_rad: Radians
    elevation_rad: SunElevation
    azimuth_sd_rad: _Deviation = 0.0
    elevation_sd_rad: _Deviation = 0.0
    known_from: Annotated[str, Meta(max_length=200)] = ""

    @property
    def sun(self) -> Sun:
        return Sun(self.azimuth_rad, self.elevation_rad)


@dataclass(frozen=True)
class Light(Checked):
    """How a photograph shows light. The default is the renderer's own: a clear day, well exposed.

    Triples are linear red, green and blue; 1 is the picture's brightest possible value.

    Attributes:
        white: value of a white matt surface in the open sun; above 1 it burns out.
        black: value of a surface that reflects no light: haze, stray light, raised blacks.
        shoulder: brightness from which the tone curve bends towards its highest value instead of
            clipping, as in most cameras; 1 is plain clipping.
        sky: the sky's share of the light on open ground, which remains in a wide shadow; 1 is an
            overcast sky without any sun.
        sun: position of the sun; None if not known.
    """

    white: tuple[_Level, _Level, _Level] = (1.0, 1.0, 1.0)
    black: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    shoulder: Annotated[float, Meta(ge=0.3, le=1)] = 1.0
    sky: tuple[Fraction, Fraction, Fraction] = CLEAR_SKY
    sun: SunEstimate | None = None


def rounded_levels(levels: Iterable[SupportsFloat]) -> tuple[float, float, float]:
    """Returns red, green and blue as a light stores them, with four decimal places."""
    red, green, blue = (round(float(level), 4) for level in levels)
    return red, green, blue
