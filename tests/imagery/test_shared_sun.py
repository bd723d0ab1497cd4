"""The sun of photographs that do not tell it, from the others of their set."""

import math

import pytest

from skyproof.imagery.clearing.sunlight import shared_sun
from skyproof.scenes.light import SunEstimate


def suns(*azimuths_deg, elevation_deg=50.0, sd_deg=10.0):
    return [
        SunEstimate(
            math.radians(azimuth_deg % 360),
            math.radians(elevation_deg + number),
            math.radians(sd_deg),
            math.radians(3),
        )
        for number, azimuth_deg in enumerate(azimuths_deg)
    ]


def test_it_is_the_median_of_those_that_agree_also_across_zero():
    shared = shared_sun(suns(350, 5, 8, 355, 2))
    assert math.degrees(shared.azimuth_rad) == pytest.approx(2, abs=0.01)
    assert math.degrees(shared.elevation_rad) == pytest.approx(52, abs=0.01)
    assert shared.known_from == "other photographs of the set"
    # As unsure as they are, and as they differ: 7.0 degrees and 1.4 around the medians.
    assert math.degrees(shared.azimuth_sd_rad) == pytest.approx(math.hypot(10, 7.0), abs=0.1)
    assert math.degrees(shared.elevation_sd_rad) == pytest.approx(math.hypot(3, 1.41), abs=0.05)


def test_suns_that_differ_and_fewer_than_three_say_nothing():
    assert shared_sun(suns(10, 20, 29)) is not None
    assert shared_sun(suns(10, 20, 41)) is None
    assert shared_sun(suns(10, 10)) is None
    assert shared_sun([]) is None
