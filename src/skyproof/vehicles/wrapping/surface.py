"""Lays the template on a hull: where its rings stand, and where the 32 points of each ring lie."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from skyproof.vehicles.bodies import CAP_RINGS, CAP_SCALES
from skyproof.vehicles.template import (
    COLUMNS,
    RINGS,
    TOPOLOGY_BELT,
    TOPOLOGY_RAIL,
    TOPOLOGY_SILL,
    column_u,
)
from skyproof.vehicles.wrapping.sections import (
    DIRECTIONS,
    Hull,
    Sections,
    cut_sections,
    find_hull,
    no_body,
)

_BODY_RINGS = RINGS - 2 * CAP_RINGS
_HALF = COLUMNS // 2
_SPACING = (0.25, 1.6)  # smallest and largest distance between rings, as a share of the mean
_EVEN = 0.06  # how much evenly spaced rings are worth, in metres of misfit
_TYRE_M = 0.24
_LEAST_LENGTH_M = 1.0
_ANGLE = np.radians(-90 + np.arange(DIRECTIONS // 2 + 1))  # of a half outline, from down to up


@dataclass(frozen=True)
class Wrapping:
    """The template on a mesh; `belt_m` is the height of the shoulder along the windows."""

    vertices: Float[Tensor, "994 3"]
    belt_m: float
    hull: Hull


def wrap_surface(corners: Float[np.ndarray, "F 3 3"]) -> Wrapping:
    """Wraps the template around a mesh.

    27 rings lie in planes across the long axis, two more and a pole close each end. Columns are
    those of drawn bodies: 0 and 1 on the floor, 2 at the lower edge, 7 at the shoulder, 11 along
    the roof rail, 16 in the middle. Between 2 and 7 they lie at even heights, elsewhere at even
    distances.
    """
    hull = find_hull(corners)
    every = cut_sections(hull)
    if not len(every.station) or np.ptp(every.station) < _LEAST_LENGTH_M:
        raise no_body()
    belt = _belt_height(every)
    # Distances from straight down to straight up, on the left and the right side.
    around = np.concatenate([every.radius, every.radius[:, :1]], axis=1)
    half = DIRECTIONS // 2
    outlines = np.stack([around[:, : half + 1], around[:, : half - 1 : -1]])
    places = _places(every, outlines.mean(0), belt)
    chosen = _choose_stations(every)[::-1].tolist()
    rings = np.stack([_ring(every, outlines[:, row], places[row], row) for row in chosen])
    upper = [column for column in range(COLUMNS) if min(column, COLUMNS - column) > TOPOLOGY_SILL]
    rings[:, upper] = hull.snap(rings[:, upper].reshape(-1, 3)).reshape(_BODY_RINGS, -1, 3)
    rings[:, _HALF, 1] = 0.0
    nose = _cap(hull, rings[0], nose=True)
    tail = _cap(hull, rings[-1], nose=False)
    body = np.concatenate([nose[1:], rings, tail[:0:-1]])
    vertices = np.concatenate([body.reshape(-1, 3), nose[:1, 0], tail[:1, 0]])
    vertices[:, 2] = (vertices[:, 2] - vertices[:, 2].min()).clip(0.0)
    return Wrapping(torch.from_numpy(vertices).float(), belt, hull)


def _profiles(sections: Sections) -> Float[np.ndarray, "S K"]:
    """Returns what the rings must follow: outline from above, roof lines, lower edge, windows."""
    y, z = sections.points()
    up = DIRECTIONS // 2
    roof = [z[:, up], (z[:, up - 30] + z[:, up + 30]) / 2, z.max(1)]
    sides = [
        (sections.radius[:, up - turn] + sections.radius[:, up + turn]) / 2 for turn in (50, 65)
    ]
    # The outline counts most: it is what an overhead view shows.
    return np.stack(
        [3 * y.max(1), -3 * y.min(1), *roof, 0.6 * sections.low, *(0.4 * side for side in sides)],
        axis=1,
    )


def _end(sections: Sections, step: int) -> int:
    """Finds the first plane behind an end that is more than 0.6 times as wide as the vehicle."""
    y, _ = sections.points()
    width = np.ptp(y, axis=1)
    cell = sections.station[1] - sections.station[0]
    limit = max(round(0.15 / cell), 3)
    order = range(1, limit) if step > 0 else range(len(width) - 2, len(width) - 1 - limit, -1)
    return next((index for index in order if width[index] > 0.6 * width.max()), order[-1])


def _choose_stations(sections: Sections) -> Int[np.ndarray, " 27"]:
    """Chooses the 27 planes between which straight lines follow the profiles best."""
    first = _end(sections, 1)
    last = _end(sections, -1)
    profiles = _profiles(sections)[first : last + 1]
    cell = float(sections.station[1] - sections.station[0])
    count = len(profiles)
    mean = (count - 1) / (_BODY_RINGS - 1)
    least = max(int(_SPACING[0] * mean), 1)
    most = max(int(np.ceil(_SPACING[1] * mean)), 2)
    cost = np.full((most + 1, count), np.inf)  # of a gap that is j planes long and ends at i
    for gap in range(least, most + 1):
        misfit = np.zeros(count - gap)
        for step in range(1, gap):
            straight = profiles[:-gap] + step / gap * (profiles[gap:] - profiles[:-gap])
            misfit += np.abs(profiles[step : count - gap + step] - straight).sum(1)
        cost[gap, gap:] = misfit * cell + _EVEN * mean * cell * (gap / mean - 1) ** 2
    # Dynamic programming: the least cost of each ring at each plane, and the gap before it.
    best = np.full((_BODY_RINGS, count), np.inf)
    came = np.zeros((_BODY_RINGS, count), np.int64)
    best[0, 0] = 0.0
    for ring in range(1, _BODY_RINGS):
        for gap in range(least, most + 1):
            total = best[ring - 1, : count - gap] + cost[gap, gap:]
            better = total < best[ring, gap:]
            best[ring, gap:][better] = total[better]
            came[ring, gap:][better] = gap
    path = [count - 1]
    for ring in range(_BODY_RINGS - 1, 0, -1):
        path.append(path[-1] - came[ring, path[-1]])
    return first + np.array(path[::-1])


def _belt_height(sections: Sections) -> float:
    """Finds the shoulder, where the middle's sides start to lean in, or 0.6 of the height."""
    y, z = sections.points()
    middle = np.abs(sections.station) < 0.3 * np.ptp(sections.station)
    side = z[middle].ravel()
    wide = np.abs(y[middle]).ravel()
    top = float(np.median(z[middle].max(1)))
    levels = np.linspace(0.45, 0.9, 46) * top
    width = np.array([np.median(wide[np.abs(side - level) < 0.02 * top]) for level in levels])
    if np.isnan(width).all():
        raise no_body()
    if width[0] - width[-1] < 0.1:
        return 0.6 * top
    # The corner of the profile: farthest outside the straight line between its ends.
    chord = np.interp(levels, levels[[0, -1]], width[[0, -1]])
    return float(levels[int(np.nanargmax(width - chord))])


def _places(
    sections: Sections, mean: Float[np.ndarray, "S 181"], belt: float
) -> Float[np.ndarray, "S 17"]:
    """Finds the (fractional) directions of columns 7 to 16 on the half outline of every plane.

    Columns 0 to 6 stay 0. The rail is smoothed along the vehicle, so that columns run evenly.
    """
    # How the columns above the belt divide the distance to the roof's middle.
    u = column_u().numpy()[: _HALF + 1]
    upper = (u[TOPOLOGY_BELT:] - u[TOPOLOGY_BELT]) / (u[_HALF] - u[TOPOLOGY_BELT])
    split = upper[TOPOLOGY_RAIL - TOPOLOGY_BELT]
    y = mean * np.cos(_ANGLE)
    z = sections.axis_z[:, None] + mean * np.sin(_ANGLE)
    # Each outline's shoulder, the lengths along it from there on, and where its rail lies.
    shoulders = [_shoulder(*each, belt) for each in zip(z, sections.axis_z.tolist(), strict=True)]
    arcs = []
    rails = np.empty(len(z))
    for row, s in enumerate(shoulders):
        out, up = y[row, s:], z[row, s:]
        along = np.r_[0.0, np.hypot(np.diff(out), np.diff(up)).cumsum()]
        along += 1e-7 * np.arange(len(out))
        # The rail is the outline's corner above the shoulder: farthest from the chord over it.
        off = np.abs((out - out[0]) * (up[-1] - up[0]) - (up - up[0]) * (out[-1] - out[0]))
        corner = along[int(np.argmax(off))] / along[-1]
        share = np.clip((z[row].max() - up[0] - 0.06) / 0.2, 0.0, 1.0)
        rails[row] = split + share * (np.clip(corner, 0.25, 0.75) - split)
        arcs.append(along)
    cell = float(sections.station[1] - sections.station[0])
    rails = gaussian_filter1d(rails, 0.08 / cell, mode="nearest")
    # Columns above the belt, by length on both sides of the rail.
    places = np.zeros((len(z), _HALF + 1))
    below, above = (upper / split).clip(0, 1), ((upper - split) / (1 - split)).clip(0, 1)
    for row, (along, rail) in enumerate(zip(arcs, rails, strict=True)):
        length = (rail * below + (1 - rail) * above) * along[-1]
        steps = np.interp(length, along, np.arange(len(along)))
        places[row, TOPOLOGY_BELT:] = shoulders[row] + steps
    return places


def _shoulder(z: Float[np.ndarray, " 181"], axis_z: float, belt: float) -> int:
    """Finds where an outline first reaches the belt; lower where bonnet or boot are lower."""
    wanted = min(belt, axis_z + 0.72 * (float(z[90:].max()) - axis_z))
    above = np.flatnonzero((z >= wanted) & (np.arange(len(z)) >= 90))
    return min(int(above[0]), 165) if len(above) else 120


def _ring(
    sections: Sections,
    halves: Float[np.ndarray, "2 181"],
    place: Float[np.ndarray, " 17"],
    row: int,
) -> Float[np.ndarray, "32 3"]:
    points = np.zeros((COLUMNS, 3))
    points[:, 0] = sections.station[row]
    axis_z, low = sections.axis_z[row], sections.low[row]
    index = np.arange(len(_ANGLE))
    for half, sign in zip(halves, (1.0, -1.0), strict=True):
        y = half * np.cos(_ANGLE)
        z = axis_z + half * np.sin(_ANGLE)
        along_y = np.interp(place, index, y)
        along_z = np.interp(place, index, z)
        top = along_z[TOPOLOGY_BELT]
        heights = np.linspace(low, top, TOPOLOGY_BELT - TOPOLOGY_SILL + 1)
        # The side as a height field; the bottom edge takes the width just above it.
        lower = index[: int(np.ceil(place[TOPOLOGY_BELT])) + 1]
        lower = lower[int(np.argmax(np.where(z[lower] < low + 0.03, y[lower], 0.0))) :]
        order = np.argsort(z[lower], kind="stable")
        widths = np.interp(heights, z[lower][order], y[lower][order])
        side = slice(TOPOLOGY_SILL, TOPOLOGY_BELT + 1)
        along_y[side], along_z[side] = widths, heights
        along_y[:2] = 0.0, max(widths[0] - _TYRE_M, 0.4 * widths[0])
        along_z[:2] = min(max(sections.floor[row], low + 0.01), low + 0.5 * (top - low))
        columns = np.arange(_HALF + 1) if sign > 0 else (COLUMNS - np.arange(_HALF + 1)) % COLUMNS
        points[columns, 1], points[columns, 2] = sign * along_y, along_z
    points[[0, _HALF], 1] = 0.0
    return points


def _cap(hull: Hull, end: Float[np.ndarray, "32 3"], *, nose: bool) -> Float[np.ndarray, "3 32 3"]:
    """A pole (first row) and two shrinking rings on a bumper's face, beyond the end ring."""
    sign = 1.0 if nose else -1.0
    pole = np.array([end[0, 0], 0.0, (end[0, 2] + end[_HALF, 2]) / 2])
    rings = []
    for scale in (0.0, *CAP_SCALES):
        ring = pole + scale * (end - pole)
        face = hull.face(ring, nose=nose)
        # Where the face is open, and under it, the cap stays flat.
        ring[:, 0] = sign * np.fmax(sign * face, sign * end[:, 0] + 0.004 * (1 - scale))
        rings.append(ring)
    return np.stack(rings)
