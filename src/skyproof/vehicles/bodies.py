"""The dimensions of real cars by body type, and random draws of them."""

from dataclasses import dataclass, fields
from pathlib import Path

import msgspec
import torch

from skyproof.errors import ConfigurationError

Range = tuple[float, float]


@dataclass(frozen=True)
class BodyDimensions:
    """The dimensions of one vehicle, in metres.

    Stations are distances behind the nose on the mid-plane. Width is without door mirrors.
    """

    length: float
    width: float
    height: float
    wheelbase: float
    front_overhang: float
    wheel_radius: float
    clearance: float
    nose_height: float  # leading edge of the bonnet
    cowl_height: float  # rear end of the bonnet
    bonnet_length: float  # nose to foot of the windscreen
    windscreen_run: float  # horizontal length of the windscreen: height and run give the rake
    rear_run: float  # horizontal length of the rear window or the rear wall of the cab
    deck_length: float  # boot lid, pickup bed, or what a hatch stands out under its window
    deck_height: float
    belt_height: float  # lower edge of the side windows
    tumblehome: float  # how far the roof rail stands inside the shoulder on each side
    bed_depth: float
    nose_bow: float  # how far the bumper corners stand behind its middle
    tail_bow: float
    roof_arch: float  # fall of the roof towards its rear end


# Outer dimensions are set around usual models of each segment as sold in 2015-2024, quoted from
# memory to about 5 cm and not checked against data sheets: saloons and estates of the D segment (VW
# Passat 4.77 x 1.83 x 1.48 m, wheelbase 2.79; BMW 3 series 4.71 x 1.83 x 1.44, 2.85; Toyota Camry
# 4.88 x 1.84 x 1.45, 2.83), hatchbacks of B and C (VW Polo 4.05 x 1.75 x 1.46, 2.55; VW Golf 4.28 x
# 1.79 x 1.49, 2.62), SUVs of C and D (Toyota RAV4 4.60 x 1.86 x 1.69, 2.69; VW Tiguan 4.51 x 1.84 x
# 1.68, 2.68), one-tonne crew cab pickups (Ford Ranger 5.37 x 1.92 x 1.88, 3.27; Toyota Hilux 5.33 x
# 1.86 x 1.82, 3.09), vans (VW Transporter 4.90 x 1.90 x 1.99, 3.00; Ford Transit Custom 5.05 x 2.03
# x 2.00, 3.10; Mercedes Sprinter 5.93 x 2.02 x 2.60, 3.67). Stations, rakes and heights between are
# our estimates.
BODY_RANGES: dict[str, dict[str, Range]] = msgspec.json.decode(
    Path(__file__).with_name("bodies.json").read_bytes(), type=dict[str, dict[str, Range]]
)
"""By body type the range from which each dimension is drawn, in metres."""

# Long cars have long wheelbases and wide bodies: the share of a dimension that follows the size.
_SIZE_SHARE = 0.6
_WITH_SIZE = ("length", "width", "wheelbase", "bonnet_length", "deck_length")


def sample_dimensions(body_type: str, *, generator: torch.Generator) -> BodyDimensions:
    """Draws the dimensions of one vehicle of a body type, a key of `BODY_RANGES`."""
    if body_type not in BODY_RANGES:
        raise ConfigurationError(
            f"Unknown body type {body_type!r}; choose from {', '.join(sorted(BODY_RANGES))}."
        )
    names = [field.name for field in fields(BodyDimensions)]
    draws = torch.rand(len(names) + 1, generator=generator, dtype=torch.float64).tolist()
    size = draws.pop()
    values = {}
    for name, draw in zip(names, draws, strict=True):
        low, high = BODY_RANGES[body_type][name]
        share = _SIZE_SHARE if name in _WITH_SIZE else 0.0
        values[name] = low + (high - low) * (share * size + (1 - share) * draw)
    return BodyDimensions(**values)
