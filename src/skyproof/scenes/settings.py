"""Settings of random scenes. Imports no torch, so that the command line answers at once."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, ImageSide, check_ranges
from skyproof.scenes.places import Places
from skyproof.scenes.scene import MOST_PLACEMENTS, SunElevation, Tilt
from skyproof.scenes.weather import CONDITIONS

_Vehicles = Annotated[int, Meta(ge=0, le=MOST_PLACEMENTS)]
_TILT_RAD = math.radians(20)
_LOWEST_SUN_RAD = math.radians(25)
_HIGHEST_SUN_RAD = math.radians(65)
TRAINING_MARGIN_M = 0.5
"""Margin of images to train on: photographs show vehicles that their edges cut in half."""
TRAINING_WEATHER = ("clear", "haze", "overcast", "exposure", "noise", "jpeg", *2 * ("low_sun",))
_VEHICLE_M2 = 80.0  # least ground per vehicle on an image to train on
_STRIDE_PX = 32  # sides of images are multiples of it, as detectors require
_SMALLEST_PX = 96

_Clearance = Annotated[float, Meta(ge=0, le=1000)]


@dataclass(frozen=True)
class SceneSettings:
    """How scenes are drawn; the defaults are the paper's test set.

    The background set gives the metres per pixel. The same seed gives the same scenes under every
    choice of conditions, except for the weather and the elevation of a low sun.

    Attributes:
        size_px: side of the image in pixels.
        vehicles_minimum, vehicles_maximum: numbers of vehicles in an image, equally likely.
        tilt_maximum_rad: largest tilt; the camera is a uniform point on a disc of its sine.
        sun: photograph or uniform. "photograph" takes the sun and the shadows of the ground if they
            are known. "uniform" draws any sun and lights vehicles everywhere, as in the paper.
        sun_elevation_minimum_rad, sun_elevation_maximum_rad: elevations of a sun that is drawn,
            equally likely; its azimuth is uniform.
        gap_m: least distance between two vehicles.
        margin_m: least distance of a vehicle's centre from the image's edge.
        places: places of vehicles: uniform (any place), removed (places of removed vehicles) or
            drivable (ground for vehicles, along its direction).
        parked_share: share of scenes with uniform places whose vehicles stand in a row.
        shaded_share: share of scenes with uniform places that are drawn up to eight times, until a
            vehicle stands half in shade or beneath a crown or roof.
        empty_share: share of scenes that get no vehicle, whatever number would be drawn.
        conditions: weather and light, each equally likely in every scene: clear, haze, rain,
            low_sun, overcast, exposure, noise, jpeg.
    """

    size_px: ImageSide = 384
    vehicles_minimum: Suppress[_Vehicles] = 1
    vehicles_maximum: Suppress[_Vehicles] = 5
    tilt_maximum_rad: Suppress[Tilt] = _TILT_RAD
    sun: Suppress[Literal["photograph", "uniform"]] = "photograph"
    sun_elevation_minimum_rad: Suppress[SunElevation] = _LOWEST_SUN_RAD
    sun_elevation_maximum_rad: Suppress[SunElevation] = _HIGHEST_SUN_RAD
    gap_m: Suppress[_Clearance] = 0.4
    margin_m: Suppress[_Clearance] = 2.0
    places: Places = "uniform"
    parked_share: Suppress[Fraction] = 0.0
    shaded_share: Suppress[Fraction] = 0.0
    empty_share: Suppress[Fraction] = 0.0
    conditions: tuple[str, ...] = ("clear",)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.vehicles_minimum > self.vehicles_maximum:
            raise ConfigurationError(
                f"vehicles_minimum {self.vehicles_minimum} and vehicles_maximum "
                f"{self.vehicles_maximum} do not fit; give 0 <= minimum <= maximum."
            )
        if self.sun_elevation_minimum_rad > self.sun_elevation_maximum_rad:
            raise ConfigurationError(
                f"sun_elevation_minimum_rad {self.sun_elevation_minimum_rad} is above "
                f"sun_elevation_maximum_rad {self.sun_elevation_maximum_rad}; change them."
            )
        for name in ("parked_share", "shaded_share"):
            share = getattr(self, name)
            if share and self.places != "uniform":
                raise ConfigurationError(
                    f"{name} {share:g} is a share of uniform places, but places are "
                    f"{self.places}; give 0."
                )
        unknown = sorted(set(self.conditions) - set(CONDITIONS))
        if unknown or not self.conditions:
            raise ConfigurationError(
                f"Scenes cannot be drawn under conditions {', '.join(unknown) or '(none)'}; "
                f"give one or more of {', '.join(CONDITIONS)}."
            )

    def half_m(self, gsd_m: float) -> float:
        """Returns the largest distance of vehicle centres from the middle on both axes."""
        half_m = self.size_px * gsd_m / 2 - self.margin_m
        if half_m <= 0:
            raise ConfigurationError(
                f"An image of {self.size_px} px of {gsd_m} m has no room inside a margin of "
                f"{self.margin_m} m; choose a larger image or a smaller margin."
            )
        return half_m

    def for_training(self, gsd_m: float, empty_share: float = 0.0) -> "SceneSettings":
        """Returns settings for images to train on, an `empty_share` of them without vehicles."""
        return replace(
            self,
            vehicles_maximum=max(1, int((self.size_px * gsd_m) ** 2 / _VEHICLE_M2)),
            conditions=TRAINING_WEATHER,
            empty_share=empty_share,
            margin_m=TRAINING_MARGIN_M,
        )


def side_px(side_m: float, gsd_m: float) -> int:
    """The side of an image at a resolution."""
    return max(_SMALLEST_PX, math.ceil(side_m / gsd_m / _STRIDE_PX) * _STRIDE_PX)
