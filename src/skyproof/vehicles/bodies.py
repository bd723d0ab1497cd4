"""Says which dimensions real cars of a kind have, and draws one."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from skyproof.errors import ConfigurationError

Range = tuple[float, float]


@dataclass(frozen=True)
class BodyRanges:
    """From where to where each dimension of one body type is drawn, in metres.

    Stations are distances behind the nose on the mid-plane. Width is without door mirrors.
    """

    length: Range
    width: Range
    height: Range
    wheelbase: Range
    front_overhang: Range
    wheel_radius: Range
    clearance: Range
    nose_height: Range  # leading edge of the bonnet
    cowl_height: Range  # rear end of the bonnet
    bonnet_length: Range  # nose to foot of the windscreen
    windscreen_run: Range  # horizontal length of the windscreen: height and run give the rake
    rear_run: Range  # horizontal length of the rear window or the rear wall of the cab
    deck_length: (
        Range  # boot lid, pickup bed, or the little that a hatch stands out under its window
    )
    deck_height: Range
    belt_height: Range  # lower edge of the side windows
    tumblehome: Range  # how far the roof rail stands inside the shoulder on each side
    bed_depth: Range = (0.0, 0.0)
    nose_bow: Range = (0.16, 0.27)  # how far the bumper corners stand behind its middle
    tail_bow: Range = (0.08, 0.16)
    roof_arch: Range = (0.03, 0.07)  # fall of the roof towards its rear end


@dataclass(frozen=True)
class BodyDimensions:
    """The dimensions of one vehicle, in metres; meanings as in `BodyRanges`."""

    length: float
    width: float
    height: float
    wheelbase: float
    front_overhang: float
    wheel_radius: float
    clearance: float
    nose_height: float
    cowl_height: float
    bonnet_length: float
    windscreen_run: float
    rear_run: float
    deck_length: float
    deck_height: float
    belt_height: float
    tumblehome: float
    bed_depth: float
    nose_bow: float
    tail_bow: float
    roof_arch: float


# Outer dimensions are set around usual models of each segment as sold in 2015-2024, quoted from
# memory to about 5 cm and not checked against data sheets: saloons and estates of the D segment (VW
# Passat 4.77 x 1.83 x 1.48 m, wheelbase 2.79; BMW 3 series 4.71 x 1.83 x 1.44, 2.85; Toyota Camry
# 4.88 x 1.84 x 1.45, 2.83), hatchbacks of B and C (VW Polo 4.05 x 1.75 x 1.46, 2.55; VW Golf 4.28 x
# 1.79 x 1.49, 2.62), SUVs of C and D (Toyota RAV4 4.60 x 1.86 x 1.69, 2.69; VW Tiguan 4.51 x 1.84 x
# 1.68, 2.68), one-tonne crew cab pickups (Ford Ranger 5.37 x 1.92 x 1.88, 3.27; Toyota Hilux 5.33 x
# 1.86 x 1.82, 3.09), vans (VW Transporter 4.90 x 1.90 x 1.99, 3.00; Ford Transit Custom 5.05 x 2.03
# x 2.00, 3.10; Mercedes Sprinter 5.93 x 2.02 x 2.60, 3.67). Stations, rakes and heights between are
# our estimates.
BODY_RANGES: dict[str, BodyRanges] = {
    "saloon": BodyRanges(
        length=(4.55, 4.95),
        width=(1.78, 1.88),
        height=(1.42, 1.49),
        wheelbase=(2.68, 2.95),
        front_overhang=(0.82, 0.94),
        wheel_radius=(0.31, 0.34),
        clearance=(0.15, 0.19),
        nose_height=(0.70, 0.76),
        cowl_height=(0.97, 1.02),
        bonnet_length=(1.18, 1.38),
        windscreen_run=(0.68, 0.85),
        rear_run=(0.60, 0.80),
        deck_length=(0.42, 0.60),
        deck_height=(1.03, 1.10),
        belt_height=(0.90, 0.95),
        tumblehome=(0.25, 0.31),
    ),
    "hatchback": BodyRanges(
        length=(3.90, 4.40),
        width=(1.70, 1.82),
        height=(1.44, 1.55),
        wheelbase=(2.48, 2.68),
        front_overhang=(0.78, 0.88),
        wheel_radius=(0.29, 0.33),
        clearance=(0.14, 0.18),
        nose_height=(0.70, 0.78),
        cowl_height=(0.98, 1.04),
        bonnet_length=(0.90, 1.12),
        windscreen_run=(0.66, 0.82),
        rear_run=(0.40, 0.58),
        deck_length=(0.12, 0.20),
        deck_height=(1.00, 1.06),
        belt_height=(0.90, 0.96),
        tumblehome=(0.22, 0.28),
    ),
    "estate": BodyRanges(
        length=(4.50, 4.95),
        width=(1.78, 1.88),
        height=(1.44, 1.52),
        wheelbase=(2.68, 2.95),
        front_overhang=(0.82, 0.94),
        wheel_radius=(0.31, 0.34),
        clearance=(0.15, 0.19),
        nose_height=(0.70, 0.76),
        cowl_height=(0.97, 1.02),
        bonnet_length=(1.15, 1.35),
        windscreen_run=(0.68, 0.85),
        rear_run=(0.32, 0.46),
        deck_length=(0.12, 0.18),
        deck_height=(1.00, 1.06),
        belt_height=(0.90, 0.95),
        tumblehome=(0.23, 0.29),
    ),
    "suv": BodyRanges(
        length=(4.35, 4.90),
        width=(1.82, 1.96),
        height=(1.62, 1.76),
        wheelbase=(2.62, 2.90),
        front_overhang=(0.84, 0.94),
        wheel_radius=(0.34, 0.38),
        clearance=(0.18, 0.23),
        nose_height=(0.86, 0.95),
        cowl_height=(1.10, 1.17),
        bonnet_length=(1.05, 1.30),
        windscreen_run=(0.60, 0.74),
        rear_run=(0.28, 0.42),
        deck_length=(0.12, 0.18),
        deck_height=(1.10, 1.18),
        belt_height=(1.02, 1.09),
        tumblehome=(0.22, 0.28),
        nose_bow=(0.14, 0.22),
    ),
    "pickup": BodyRanges(
        length=(5.15, 5.55),
        width=(1.84, 1.98),
        height=(1.78, 1.88),
        wheelbase=(3.08, 3.30),
        front_overhang=(0.88, 0.98),
        wheel_radius=(0.37, 0.41),
        clearance=(0.22, 0.27),
        nose_height=(0.98, 1.06),
        cowl_height=(1.18, 1.25),
        bonnet_length=(1.20, 1.36),
        windscreen_run=(0.58, 0.70),
        rear_run=(0.16, 0.26),
        deck_length=(1.50, 1.80),
        deck_height=(1.18, 1.26),
        belt_height=(1.12, 1.18),
        tumblehome=(0.22, 0.27),
        bed_depth=(0.44, 0.52),
        nose_bow=(0.13, 0.20),
        tail_bow=(0.02, 0.05),
    ),
    "van": BodyRanges(
        length=(4.90, 5.95),
        width=(1.90, 2.05),
        height=(1.95, 2.50),
        wheelbase=(3.00, 3.65),
        front_overhang=(0.88, 0.98),
        wheel_radius=(0.33, 0.36),
        clearance=(0.16, 0.20),
        nose_height=(0.92, 1.00),
        cowl_height=(1.22, 1.30),
        bonnet_length=(0.68, 0.88),
        windscreen_run=(0.66, 0.84),
        rear_run=(0.08, 0.14),
        deck_length=(0.12, 0.14),
        deck_height=(1.70, 1.85),
        belt_height=(1.14, 1.22),
        tumblehome=(0.11, 0.16),
        nose_bow=(0.20, 0.28),
        tail_bow=(0.02, 0.05),
        roof_arch=(0.0, 0.02),
    ),
}

# How much of a dimension goes with the vehicle's overall size: long cars have long wheelbases and
# wide bodies.
_SIZE_SHARE = 0.6


def sample_dimensions(body_type: str, *, generator: torch.Generator) -> BodyDimensions:
    """Draws the dimensions of one vehicle of a body type.

    Args:
        body_type: a key of `BODY_RANGES`.
        generator: CPU generator.

    Raises:
        ConfigurationError: an unknown body type.
    """
    if body_type not in BODY_RANGES:
        raise ConfigurationError(
            f"Unknown body type {body_type!r}; choose from {', '.join(sorted(BODY_RANGES))}."
        )
    ranges = BODY_RANGES[body_type]
    names = [field.name for field in fields(ranges)]
    draws = torch.rand(len(names) + 1, generator=generator, dtype=torch.float64).tolist()
    size = draws.pop()
    values = {}
    for name, draw in zip(names, draws, strict=True):
        low, high = getattr(ranges, name)
        share = (
            _SIZE_SHARE
            if name in ("length", "width", "wheelbase", "bonnet_length", "deck_length")
            else 0.0
        )
        values[name] = low + (high - low) * (share * size + (1 - share) * draw)
    return BodyDimensions(**values)
