"""The dimensions of real cars by body type, random draws of them, and surfaces of such bodies.

A surface has one cross-section per ring and two end caps.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.vehicles.template import (
    COLUMNS,
    RINGS,
    TOPOLOGY_BELT,
    TOPOLOGY_RAIL,
    TOPOLOGY_SILL,
    column_u,
)

# Long cars have long wheelbases and wide bodies, so this share of a dimension follows size.
_SIZE_SHARE = 0.6
_WITH_SIZE = ("length", "width", "wheelbase", "bonnet_length", "deck_length")
_HALF = COLUMNS // 2
CAP_RINGS = 2  # rings inside each bumper's face
CAP_SCALES = (0.45, 0.86)
_CAP_DEPTH_M = 0.06
_SMOOTHING_M = 0.13
# Half the length of a tyre's contact patch, and its least share of the space between two rings, so
# that at least one ring reaches the ground.
_FLAT_TYRE_M, _FLAT_TYRE_SHARE = 0.125, 0.4

_Rings = Float[Tensor, " 27"]
"""One number for each ring between the caps."""


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
    deck_length: float  # boot lid, pickup bed, or how far a hatch protrudes below its window
    deck_height: float
    belt_height: float  # lower edge of the side windows
    tumblehome: float  # how far the roof rail stands inside the shoulder on each side
    bed_depth: float
    nose_bow: float  # how far a bumper's corners lie behind its middle
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
# our estimates, and so are those of buses and lorries. 2.55 m is the legal width in Europe.
BODY_RANGES = msgspec.json.decode(
    Path(__file__).with_name("bodies.json").read_bytes(),
    type=dict[str, dict[str, tuple[float, float]]],
)
"""By body type the range from which each dimension is drawn, in metres."""


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


@dataclass(frozen=True)
class Body:
    """One vehicle's surface, and what painting it needs, in metres and vehicle axes.

    `half` holds nose pole, rings and tail pole; columns run from the middle of the underside up the
    left side to the middle of the roof. `station` is how far each ring's middle lies behind the
    nose. `belt_z` and `rail_z` are heights of shoulder and roof rail, `rail_y` half its width.
    """

    dimensions: BodyDimensions
    half: Float[Tensor, "33 17 3"]
    station: Float[Tensor, " 33"]
    belt_z: Float[Tensor, " 33"]
    rail_z: Float[Tensor, " 33"]
    rail_y: Float[Tensor, " 33"]

    @property
    def vertices(self) -> Float[Tensor, "994 3"]:
        """Returns vertices in template order; the right half mirrors the left half, bit for bit."""
        right = self.half[1:-1, 1:-1].flip(1) * self.half.new_tensor([1.0, -1.0, 1.0])
        rings = torch.cat([self.half[1:-1], right], dim=1).reshape(-1, 3)
        return torch.cat([rings, self.half[0, :1], self.half[-1, :1]]).float()


def interpolate(
    at: Float[Tensor, " *at"], x: Float[Tensor, " K"], y: Float[Tensor, " K"]
) -> Float[Tensor, " *at"]:
    """Returns piecewise linear y(at), constant beyond the ends; x ascending."""
    right = torch.searchsorted(x, at.contiguous()).clamp(1, len(x) - 1)
    share = ((at - x[right - 1]) / (x[right] - x[right - 1])).clamp(0.0, 1.0)
    return y[right - 1] + share * (y[right] - y[right - 1])


def build_body(dimensions: BodyDimensions) -> Body:
    """Builds a surface of exactly the given length, width and height; its tyres stand on z = 0."""
    profile = _profiles(dimensions)
    station = _ring_stations(dimensions, profile)
    sections, belt_z, rail_z, rail_y = _sections(dimensions, profile, station)
    half = _close(dimensions, sections)

    size = half.new_tensor([dimensions.length, dimensions.width, dimensions.height])
    low = half.amin((0, 1))
    high = half.amax((0, 1))
    scale = size / torch.stack([high[0] - low[0], 2 * high[1], high[2]])
    half[..., 0] -= (high[0] + low[0]) / 2
    belt_z, rail_z, rail_y = (
        torch.cat([row[:1].expand(3), row, row[-1:].expand(3)]) * factor
        for row, factor in ((belt_z, scale[2]), (rail_z, scale[2]), (rail_y, scale[1]))
    )
    ends = station[-1] + _CAP_DEPTH_M
    caps = torch.linspace(0.0, 1.0, 4, dtype=station.dtype)[:-1]
    behind = ends - (ends - station[-1]) * caps.flip(0)
    station = torch.cat([station[0] * caps, station, behind])
    return Body(dimensions, half * scale, station, belt_z, rail_z, rail_y)


def _fade(distance: Float[Tensor, "*S"], reach: float) -> Float[Tensor, "*S"]:
    """Falls from 1 at distance 0 to 0 at `reach`, where the curve becomes level."""
    return (1 - distance / reach).clamp(0.0) ** 2


def _smooth(values: Float[Tensor, " N"], window: int) -> Float[Tensor, " N"]:
    padded = torch.nn.functional.pad(values[None], (window, window), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, 2 * window + 1, stride=1)[0]


def _profiles(d: BodyDimensions) -> dict[str, Float[Tensor, " N"]]:
    """Roof line, shoulder line and depth of a pickup's bed, on a fine grid of stations."""
    tail = d.length - _CAP_DEPTH_M
    at = torch.linspace(_CAP_DEPTH_M, tail, 640, dtype=torch.float64)
    step = float(at[1] - at[0])
    roof_front = d.bonnet_length + d.windscreen_run
    deck = d.length - d.deck_length
    roof_end = deck - d.rear_run
    roof_length = roof_end - roof_front
    deck_fall = 0.0 if d.bed_depth else 0.02
    # Roof line: nose, bonnet, windscreen, roof, rear window, boot or bed.
    top = [
        (_CAP_DEPTH_M, d.nose_height - 0.10),
        (0.22, d.nose_height),
        (d.bonnet_length * 0.6, 0.45 * d.nose_height + 0.55 * d.cowl_height + 0.02),
        (d.bonnet_length, d.cowl_height),
        (roof_front, d.height - 0.03),
        (roof_front + 0.35 * roof_length, d.height),
        (roof_end, d.height - d.roof_arch),
        (deck, d.deck_height),
        (d.length - 0.11, d.deck_height - deck_fall),
        (tail, d.deck_height - (0.02 if d.bed_depth else 0.09)),
    ]
    # Shoulder line; a pickup's follows the sides of its bed.
    belt_rear = min(d.belt_height + 0.04, d.deck_height - 0.05)
    belt = [
        (_CAP_DEPTH_M, d.nose_height - 0.16),
        (0.30, d.nose_height - 0.05),
        (d.bonnet_length, d.belt_height - 0.02),
        (0.55 * d.length, d.belt_height),
        (d.length - 0.20, belt_rear),
        (tail, belt_rear - 0.03),
    ]
    if d.bed_depth:
        belt[3:] = [
            (roof_end, d.belt_height),
            (deck, d.deck_height - 0.03),
            (tail, d.deck_height - 0.04),
        ]
    # Both are smoothed, and the shoulder is kept below the roof line.
    curves = {"at": at}
    for name, points in (("top", top), ("belt", belt)):
        x, y = torch.tensor(points, dtype=torch.float64).T.contiguous()
        curves[name] = _smooth(interpolate(at, x, y), round(_SMOOTHING_M / 2 / step))
    curves["belt"] = torch.minimum(curves["belt"], curves["top"] - 0.03)
    # Depth of the bed between its walls.
    wall = torch.tensor(
        [deck + 0.08, deck + 0.13, d.length - 0.14, d.length - 0.09], dtype=torch.float64
    )
    curves["depth"] = interpolate(at, wall, d.bed_depth * wall.new_tensor([0.0, 1.0, 1.0, 0.0]))
    return curves


def _ring_stations(d: BodyDimensions, profile: dict[str, Float[Tensor, " N"]]) -> _Rings:
    """Spaces the rings between the caps evenly along the centre line, one at each body edge."""
    at = profile["at"]
    height = profile["top"] - profile["depth"]
    arc = torch.cat([at.new_zeros(1), torch.hypot(at.diff(), 0.9 * height.diff()).cumsum(0)])
    deck = d.length - d.deck_length
    keys = [d.bonnet_length, d.bonnet_length + d.windscreen_run, deck - d.rear_run, deck]
    if d.bed_depth:
        keys += [deck + 0.08, deck + 0.13, d.length - 0.14, d.length - 0.09]
    stations = torch.tensor([float(at[0]), *keys, float(at[-1])], dtype=torch.float64)
    last = RINGS - 2 * CAP_RINGS - 1
    arcs = interpolate(stations, at, arc)
    rings = (last * arcs / arcs[-1]).round().long().tolist()
    for i in range(1, len(rings)):
        rings[i] = max(rings[i], rings[i - 1] + 1)
    rings[-1] = last
    for i in reversed(range(len(rings) - 1)):
        rings[i] = min(rings[i], rings[i + 1] - 1)
    ring_arc = interpolate(
        torch.arange(last + 1, dtype=torch.float64), torch.tensor(rings, dtype=torch.float64), arcs
    )
    return interpolate(ring_arc, arc, at)


def _sections(
    d: BodyDimensions, profile: dict[str, Float[Tensor, " N"]], station: _Rings
) -> tuple[Float[Tensor, "27 17 3"], _Rings, _Rings, _Rings]:
    """Returns the left half, belt height, rail height and rail half width of each ring."""
    top, belt, depth = (
        interpolate(station, profile["at"], profile[name]) for name in ("top", "belt", "depth")
    )
    # Half widths: narrower towards the ends.
    from_tail = d.length - station
    rear, reach = (0.02, 0.5) if d.bed_depth or d.deck_height > 1.5 else (0.06, 0.9)
    taper = 0.10 * _fade(station, 1.0) + rear * _fade(from_tail, reach)
    half_width = d.width / 2 * (1 - taper)

    # Bumpers bow in plan view, and so do windscreen and rear window, but these only above the belt.
    bow = d.nose_bow * _fade(station, 0.75) - d.tail_bow * _fade(from_tail, 0.6)
    roof_front = d.bonnet_length + d.windscreen_run
    at = station.new_tensor([0.4 * d.bonnet_length, d.bonnet_length, roof_front, roof_front + 0.5])
    glass_bow = interpolate(station, at, at.new_tensor([0.0, 0.17, 0.08, 0.0]))

    lower = _lower_side(d, station + bow, half_width, belt)
    upper, rail_z, rail_y = _upper_side(d, lower[:, -1], top, belt)
    if d.bed_depth:
        _sink_bed(upper, depth)
    yz = torch.cat([_underside(d, lower[:, 0]), lower, upper[:, 1:]], dim=1)
    across = (yz[..., 0] / half_width[:, None]) ** 2
    above = torch.zeros(_HALF + 1, dtype=torch.float64)
    above[TOPOLOGY_BELT - 1 :] = 1.0
    above[TOPOLOGY_BELT - 1] = 0.5
    behind_nose = station[:, None] + across * (bow[:, None] + above * glass_bow[:, None])
    return torch.cat([(d.length / 2 - behind_nose)[..., None], yz], dim=-1), belt, rail_z, rail_y


def _lower_side(
    d: BodyDimensions, station: _Rings, half_width: _Rings, belt: _Rings
) -> Float[Tensor, "27 6 2"]:
    """Returns (y, z) from the sill, or the ground under a tyre, up to the shoulder."""
    # The bumpers' lower edges are higher than the sill.
    ends = torch.minimum(station, d.length - station)
    bottom = d.clearance + 0.08 * (1 - ends / 0.6).clamp(0.0)
    wheel = torch.zeros_like(station)
    flat_m = max(_FLAT_TYRE_M, _FLAT_TYRE_SHARE * float(station.diff().amax()))
    for axle in (d.front_overhang, d.front_overhang + d.wheelbase):
        distance = (station - axle).abs()
        reach = (distance - flat_m).clamp(0.0) / (0.95 * d.wheel_radius)
        tyre = d.wheel_radius * (1 - (1 - reach**2).clamp(0.0).sqrt())
        bottom = torch.minimum(bottom, tyre)
        wheel = torch.maximum(wheel, (1 - (distance / (1.5 * d.wheel_radius)) ** 2).clamp(0.0))
    share = torch.linspace(0.0, 1.0, TOPOLOGY_BELT - TOPOLOGY_SILL + 1, dtype=torch.float64)
    inset = torch.tensor([0.07, 0.03, 0.012, 0.010, 0.022, 0.065], dtype=torch.float64)
    bulge = torch.tensor([0.035, 0.022, 0.012, 0.010, 0.006, 0.0], dtype=torch.float64)
    y = half_width[:, None] - inset + wheel[:, None] * bulge
    return torch.stack([y, bottom[:, None] + share * (belt - bottom)[:, None]], dim=-1)


def _upper_side(
    d: BodyDimensions, shoulder: Float[Tensor, "27 2"], top: _Rings, belt: _Rings
) -> tuple[Float[Tensor, "27 10 2"], _Rings, _Rings]:
    """Returns (y, z) from the shoulder over the roof rail to the middle of roof, bonnet or boot."""
    height = top - belt
    crown = torch.minimum(0.5 * height, torch.full_like(height, 0.045))
    rail_z = top - crown
    lean = (height / (d.height - d.belt_height)).clamp(0.0, 1.0)
    rail_y = shoulder[:, 0] - 0.015 - d.tumblehome * lean

    # Where there are windows a column runs along the roof rail; on bonnet and boot the columns
    # spread evenly.
    side = torch.hypot(shoulder[:, 0] - rail_y, rail_z - belt)[:, None]
    u = column_u()[TOPOLOGY_BELT : _HALF + 1]
    split = TOPOLOGY_RAIL - TOPOLOGY_BELT
    on_side = ((u - u[0]) / (u[split] - u[0])).clamp(max=1.0)
    on_top = ((u - u[split]) / (u[-1] - u[split])).clamp(min=0.0)
    even = (u - u[0]) / (u[-1] - u[0]) * (side + rail_y[:, None])
    share = ((height - 0.06) / 0.2).clamp(0.0, 1.0)[:, None]
    along = even + share * (side * on_side + rail_y[:, None] * on_top - even)

    up = (along / side).clamp(max=1.0)
    inward = ((along - side) / rail_y[:, None]).clamp(0.0, 1.0)
    # Windows bulge by 1.5 cm.
    bulge = 0.06 * up * (1 - up) * share
    y = shoulder[:, :1] + up * (rail_y - shoulder[:, 0])[:, None] + bulge - inward * rail_y[:, None]
    over = (top - rail_z)[:, None] * (1 - (1 - inward) ** 2)
    z = belt[:, None] + up * (rail_z - belt)[:, None] + over
    y[:, -1] = 0.0
    return torch.stack([y, z], dim=-1), rail_z, rail_y


def _sink_bed(upper: Float[Tensor, "27 10 2"], depth: _Rings) -> None:
    """Lowers the inner points of a pickup's bed rings, leaving a rim of 9 cm."""
    inside = depth > 0
    rim = upper[:, 0, 0]
    shares = torch.linspace(1.0, 0.0, upper.shape[1] - 2, dtype=torch.float64)
    floor = (rim - 0.10)[:, None] * shares
    upper[inside, 1, 0] = (rim - 0.08)[inside]
    upper[inside, 2:, 0] = floor[inside]
    upper[inside, 2:, 1] -= depth[inside, None]


def _underside(d: BodyDimensions, sill: Float[Tensor, "27 2"]) -> Float[Tensor, "27 2 2"]:
    """Returns (y, z) of the middle of the floor and of its outer edge, inside the tyres."""
    floor = (sill[:, 1] + 0.01).clamp(min=d.clearance + 0.03)
    y = torch.stack([torch.zeros_like(floor), sill[:, 0] - 0.24], dim=1)
    return torch.stack([y, floor[:, None].expand(-1, 2)], dim=-1)


def _close(d: BodyDimensions, sections: Float[Tensor, "27 17 3"]) -> Float[Tensor, "33 17 3"]:
    """Adds two shrinking rings and a pole at each end."""

    def cap(end: Float[Tensor, "17 3"], sign: float, pole_z: float) -> list[Tensor]:
        pole = end.new_tensor([0.0, 0.0, pole_z])
        rings = []
        for scale in (0.0, *CAP_SCALES):
            ring = pole + scale * (end - pole)
            # The end section's own bow, and a rounded edge of 6 cm.
            bow = (end[:, 0] - end[-1, 0]) * scale**2
            ring[:, 0] = end[-1, 0] + bow + sign * _CAP_DEPTH_M * (1 - scale**4)
            rings.append(ring)
        return rings

    nose = cap(sections[0], 1.0, 0.52 * (d.nose_height + 0.15))
    tail = cap(sections[-1], -1.0, 0.5 * (float(sections[-1, -1, 2]) + 0.2))
    return torch.stack([*nose, *sections, *reversed(tail)])
