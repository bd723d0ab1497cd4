"""Builds a vehicle's surface from its dimensions: one cross-section per ring, two end caps."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.vehicles.bodies import BodyDimensions
from skyproof.vehicles.template import (
    COLUMNS,
    RINGS,
    TOPOLOGY_BELT,
    TOPOLOGY_RAIL,
    TOPOLOGY_SILL,
    column_u,
)

_HALF = COLUMNS // 2
_CAP_RINGS = 2  # rings inside each bumper's face
_CAP_SCALES = (0.45, 0.86)
_CAP_DEPTH_M = 0.06
_SMOOTHING_M = 0.13
_FLAT_TYRE_M = (
    0.125  # half the length of the tyre's contact, so that at least one ring reaches the ground
)


@dataclass(frozen=True)
class Body:
    """One vehicle's surface, and the places that its painter needs.

    Attributes:
        half: `[33, 17, 3]` metres, vehicle axes: nose pole, rings, tail pole by columns from the
            middle of the underside up the left side to the middle of the roof.
        station: `[33]` distance behind the nose of each ring's middle.
        belt_z, rail_z, rail_y: `[33]` heights of shoulder and roof rail, half width at the roof
            rail.
    """

    dimensions: BodyDimensions
    half: Float[Tensor, "33 17 3"]
    station: Float[Tensor, " 33"]
    belt_z: Float[Tensor, " 33"]
    rail_z: Float[Tensor, " 33"]
    rail_y: Float[Tensor, " 33"]

    @property
    def vertices(self) -> Float[Tensor, "994 3"]:
        """`[994, 3]` float32 in template order; the right half is the left half reflected, bit for
        bit.
        """
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
    """Builds the surface, exactly as long, wide and high as asked; the tyres stand on z = 0."""
    profile = _profiles(dimensions)
    station = _ring_stations(dimensions, profile)
    sections, belt_z, rail_z, rail_y = _sections(dimensions, profile, station)
    half = _close(dimensions, sections)

    size = half.new_tensor([dimensions.length, dimensions.width, dimensions.height])
    low = half.amin((0, 1))
    high = half.amax((0, 1))
    extent = torch.stack([high[0] - low[0], 2 * high[1], high[2]])
    middle = torch.stack([(high[0] + low[0]) / 2, low.new_zeros(()), low.new_zeros(())])
    scale = size / extent
    half = (half - middle) * scale
    padded = [
        torch.cat([row[:1].expand(3), row, row[-1:].expand(3)]) for row in (belt_z, rail_z, rail_y)
    ]
    ends = station[-1] + _CAP_DEPTH_M
    caps = torch.linspace(0.0, 1.0, 4, dtype=station.dtype)[:-1]
    full_station = torch.cat(
        [station[0] * caps, station, ends - (ends - station[-1]) * caps.flip(0)]
    )
    return Body(
        dimensions,
        half,
        full_station,
        padded[0] * scale[2],
        padded[1] * scale[2],
        padded[2] * scale[1],
    )


def _smooth(values: Float[Tensor, " N"], window: int) -> Float[Tensor, " N"]:
    padded = torch.cat([values[:1].expand(window), values, values[-1:].expand(window)])
    return torch.nn.functional.avg_pool1d(padded[None], 2 * window + 1, stride=1)[0]


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
    # Both smoothed, the shoulder below the roof line.
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


def _ring_stations(
    d: BodyDimensions, profile: dict[str, Float[Tensor, " N"]]
) -> Float[Tensor, " 27"]:
    """Stations of the rings between the caps: even along the centre line, one at each body edge."""
    at = profile["at"]
    height = profile["top"] - profile["depth"]
    arc = torch.cat([at.new_zeros(1), torch.hypot(at.diff(), 0.9 * height.diff()).cumsum(0)])
    deck = d.length - d.deck_length
    keys = [d.bonnet_length, d.bonnet_length + d.windscreen_run, deck - d.rear_run, deck]
    if d.bed_depth:
        keys += [deck + 0.08, deck + 0.13, d.length - 0.14, d.length - 0.09]
    stations = torch.tensor([float(at[0]), *keys, float(at[-1])], dtype=torch.float64)
    last = RINGS - 2 * _CAP_RINGS - 1
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
    d: BodyDimensions, profile: dict[str, Float[Tensor, " N"]], station: Float[Tensor, " 27"]
) -> tuple[
    Float[Tensor, "27 17 3"], Float[Tensor, " 27"], Float[Tensor, " 27"], Float[Tensor, " 27"]
]:
    """Returns the left half, belt height, rail height and rail half width of each ring."""
    top, belt, depth = (
        interpolate(station, profile["at"], profile[name]) for name in ("top", "belt", "depth")
    )
    # Half widths: narrower towards the ends.
    from_tail = d.length - station
    taper = (
        0.10 * (1 - station / 1.0).clamp(0.0) ** 2 + 0.06 * (1 - from_tail / 0.9).clamp(0.0) ** 2
    )
    if d.bed_depth or d.deck_height > 1.5:
        taper = (
            0.10 * (1 - station / 1.0).clamp(0.0) ** 2
            + 0.02 * (1 - from_tail / 0.5).clamp(0.0) ** 2
        )
    half_width = d.width / 2 * (1 - taper)

    # Bumpers bow in plan view, and so do windscreen and rear window, but these only above the belt.
    bow = (
        d.nose_bow * (1 - station / 0.75).clamp(0.0) ** 2
        - d.tail_bow * (1 - from_tail / 0.6).clamp(0.0) ** 2
    )
    roof_front = d.bonnet_length + d.windscreen_run
    points = [
        (0.4 * d.bonnet_length, 0.0),
        (d.bonnet_length, 0.17),
        (roof_front, 0.08),
        (roof_front + 0.5, 0.0),
    ]
    x, y = torch.tensor(points, dtype=torch.float64).T.contiguous()
    glass_bow = interpolate(station, x, y)

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
    d: BodyDimensions,
    station: Float[Tensor, " 27"],
    half_width: Float[Tensor, " 27"],
    belt: Float[Tensor, " 27"],
) -> Float[Tensor, "27 6 2"]:
    """Returns (y, z) from the sill, or the ground under a tyre, up to the shoulder."""
    # The bumpers' lower edges are higher than the sill.
    ends = torch.minimum(station, d.length - station)
    bottom = d.clearance + 0.08 * (1 - ends / 0.6).clamp(0.0)
    wheel = torch.zeros_like(station)
    for axle in (d.front_overhang, d.front_overhang + d.wheelbase):
        distance = (station - axle).abs()
        reach = (distance - _FLAT_TYRE_M).clamp(0.0) / (0.95 * d.wheel_radius)
        tyre = d.wheel_radius * (1 - (1 - reach**2).clamp(0.0).sqrt())
        bottom = torch.minimum(bottom, tyre)
        wheel = torch.maximum(wheel, (1 - (distance / (1.5 * d.wheel_radius)) ** 2).clamp(0.0))
    share = torch.linspace(0.0, 1.0, TOPOLOGY_BELT - TOPOLOGY_SILL + 1, dtype=torch.float64)
    inset = torch.tensor([0.07, 0.03, 0.012, 0.010, 0.022, 0.065], dtype=torch.float64)
    bulge = torch.tensor([0.035, 0.022, 0.012, 0.010, 0.006, 0.0], dtype=torch.float64)
    y = half_width[:, None] - inset + wheel[:, None] * bulge
    return torch.stack([y, bottom[:, None] + share * (belt - bottom)[:, None]], dim=-1)


def _upper_side(
    d: BodyDimensions,
    shoulder: Float[Tensor, "27 2"],
    top: Float[Tensor, " 27"],
    belt: Float[Tensor, " 27"],
) -> tuple[Float[Tensor, "27 10 2"], Float[Tensor, " 27"], Float[Tensor, " 27"]]:
    """Returns (y, z) from the shoulder over the roof rail to the middle of roof, bonnet or boot."""
    height = top - belt
    crown = torch.minimum(0.5 * height, torch.full_like(height, 0.045))
    rail_z = top - crown
    rail_y = (
        shoulder[:, 0]
        - 0.015
        - d.tumblehome * (height / (d.height - d.belt_height)).clamp(0.0, 1.0)
    )

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
    y = (
        shoulder[:, :1]
        + up * (rail_y - shoulder[:, 0])[:, None]
        + 0.06 * up * (1 - up) * share
        - inward * rail_y[:, None]
    )
    z = (
        belt[:, None]
        + up * (rail_z - belt)[:, None]
        + (top - rail_z)[:, None] * (1 - (1 - inward) ** 2)
    )
    y[:, -1] = 0.0
    return torch.stack([y, z], dim=-1), rail_z, rail_y


def _sink_bed(upper: Float[Tensor, "27 10 2"], depth: Float[Tensor, " 27"]) -> None:
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
    floor = torch.full_like(sill[:, 0], d.clearance + 0.03)
    floor = torch.maximum(floor, sill[:, 1] + 0.01)
    inner = torch.stack([sill[:, 0] - 0.24, floor], dim=-1)
    return torch.stack([torch.stack([torch.zeros_like(floor), floor], dim=-1), inner], dim=1)


def _close(d: BodyDimensions, sections: Float[Tensor, "27 17 3"]) -> Float[Tensor, "33 17 3"]:
    """Adds two shrinking rings and a pole at each end."""

    def cap(end: Float[Tensor, "17 3"], sign: float, pole_z: float) -> list[Tensor]:
        pole = end.new_tensor([0.0, 0.0, pole_z])
        rings = []
        for scale in (0.0, *_CAP_SCALES):
            ring = pole + scale * (end - pole)
            # The end section's own bow, and a rounded edge of 6 cm.
            bow = (end[:, 0] - end[-1, 0]) * scale**2
            ring[:, 0] = end[-1, 0] + bow + sign * _CAP_DEPTH_M * (1 - scale**4)
            rings.append(ring)
        return rings

    nose = cap(sections[0], 1.0, 0.52 * (d.nose_height + 0.15))
    tail = cap(sections[-1], -1.0, 0.5 * (float(sections[-1, -1, 2]) + 0.2))
    return torch.stack([*nose, *sections, *reversed(tail)])
