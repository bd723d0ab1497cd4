"""Finds a vehicle's hull from six sides, without interior and wheel gaps, and cuts it crosswise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import binary_opening, grey_closing, grey_opening, label, median_filter

from skyproof.errors import ConfigurationError
from skyproof.vehicles.wrapping.views import parallel_view

DIRECTIONS = 360  # around the axis: one degree, 16 mm at 0.9 m
_CELL_M = 0.01
_THIN_M = 0.32  # narrower parts of the outline are left out: mirrors, aerials
_WHEEL_GAP_M = 0.14  # between tyre and arch, and other gaps in the sides
_RUNGS_M = 0.26  # gaps on a roof, between rungs of a ladder or bars of a rack
_CLEAR_M = 0.4


@dataclass(frozen=True)
class Hull:
    """The smoothed outer surface as height fields over square cells, metres.

    Cell `[i, j]` has its centre at `start + (i + 0.5, j + 0.5) * cell` on its two axes.

    Attributes:
        top: height seen from above; -inf without surface.
        sides: distance from y = 0 seen from left and right; 0 without surface.
        front, rear: x seen from the front and from behind; NaN without surface.
        low: lower edge seen from the side: tyres, sills, bumpers.
        floor: height of the underside between the wheels.
    """

    cell: float
    start: Float[np.ndarray, " 3"]
    top: Float[np.ndarray, "X Y"]
    sides: Float[np.ndarray, "2 X Z"]
    front: Float[np.ndarray, "Y Z"]
    rear: Float[np.ndarray, "Y Z"]
    low: Float[np.ndarray, " X"]
    floor: Float[np.ndarray, " X"]

    def index(
        self, values: Float[np.ndarray, "*N"], axis: int, count: int
    ) -> Int[np.ndarray, "*N"]:
        """Returns the cell along one axis, clamped to the grid."""
        return np.floor((values - self.start[axis]) / self.cell).astype(np.int64).clip(0, count - 1)

    def snap(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Moves points within a cell of the surface onto it, whichever way is nearer."""
        column = self.index(points[:, 0], 0, self.top.shape[0])
        _, across, height = ((points - self.start) / self.cell - 0.5).T
        top = _between(self.top[column], across) - points[:, 2]
        edges = self.sides[(points[:, 1] < 0).astype(np.int64), column]
        out = _between(edges, height) - np.abs(points[:, 1])
        up = np.abs(top) <= np.abs(out)
        near = np.minimum(np.abs(top), np.abs(out)) < self.cell
        snapped = points.copy()
        snapped[near & up, 2] += top[near & up]
        snapped[near & ~up, 1] += (np.sign(points[:, 1]) * out)[near & ~up]
        return snapped

    def inside(self, points: Float[np.ndarray, "N 3"], slack_m: float) -> np.ndarray:
        """Says which points lie inside the outline from above and the sides, to `slack_m`."""
        column = self.index(points[:, 0], 0, self.top.shape[0])
        height = self.index(points[:, 2], 2, self.sides.shape[2])
        edges = self.sides[(points[:, 1] < 0).astype(np.int64), column, height]
        ends = np.flatnonzero(np.isfinite(self.top).any(1))[[0, -1]] * self.cell + self.start[0]
        along = (points[:, 0] > ends[0] - slack_m) & (points[:, 0] < ends[1] + self.cell + slack_m)
        return along & (np.abs(points[:, 1]) < edges + slack_m)

    def face(self, points: Float[np.ndarray, "N 3"], *, nose: bool) -> Float[np.ndarray, " N"]:
        """Returns x of the surface in front of (or behind) points; NaN where nothing is."""
        seen = self.front if nose else self.rear
        across = self.index(points[:, 1], 1, seen.shape[0])
        return seen[across, self.index(points[:, 2], 2, seen.shape[1])]


def no_body() -> ConfigurationError:
    """Returns the error for a mesh that the template cannot be wrapped around."""
    return ConfigurationError(
        "The mesh has no closed body: a piece wider than "
        f"{_THIN_M:g} m that goes on from nose to tail was expected; give the mesh of a whole "
        "vehicle, or --wrapping.up and --wrapping.forward if it lies otherwise."
    )


def find_hull(corners: Float[np.ndarray, "F 3 3"]) -> Hull:
    """Finds a mesh's hull, looking at it from six sides.

    Mirrors and other parts narrower than 32 cm are removed from the outline from above. Gaps are
    closed up to 14 cm in the sides (wheel arches) and up to 26 cm on top (ladders).
    """
    points = corners.reshape(-1, 3)
    extent = np.ptp(points, axis=0)
    cell = max(_CELL_M, float(extent[0]) / 700)
    margin = 2 * cell
    start = points.min(0) - margin
    counts = np.ceil((extent + 2 * margin) / cell).astype(int)

    def look(first: int, second: int, depth: int, sign: float) -> np.ndarray:
        """Returns the largest `sign * depth` over cells of two axes; -inf where nothing is."""
        view = corners[..., [second, first, depth]] * [1.0, 1.0, -sign]
        size = (int(counts[first]), int(counts[second]))
        seen = parallel_view(view, start[[second, first]], cell, size)
        value = np.einsum("xyk,xyk->xy", seen.weights, corners[seen.face][..., depth]) * sign
        return np.where(seen.face >= 0, value, -np.inf)

    # From above: outline and roof, without ladders.
    top = look(0, 1, 2, 1.0)
    radius = int(np.ceil(_THIN_M / 2 / cell))
    step = np.arange(-radius, radius + 1)
    disc = step[:, None] ** 2 + step[None] ** 2 <= (_THIN_M / 2 / cell) ** 2
    footprint = binary_opening(np.isfinite(top), disc)
    if not footprint.any():
        raise no_body()
    pieces, _ = label(footprint)
    footprint = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    # Removes thin aerials; a few millimetres of noise may stay.
    top = grey_opening(np.where(footprint, top, -1.0), 3)
    top = grey_closing(top, round(_RUNGS_M / cell), mode="nearest")
    top = np.where(footprint, top, -np.inf)

    # From the sides, without mirrors, and with closed wheel arches.
    y = start[1] + (np.arange(counts[1]) + 0.5) * cell
    reach = np.stack([np.where(footprint, side, 0.0).max(1) + cell / 2 for side in (y, -y)])
    reach[:, ~footprint.any(1)] = 0.0
    sides = np.stack([look(0, 2, 1, 1.0), look(0, 2, 1, -1.0)]).clip(0.0)
    # The outline leaves a mirror's foot, which is removed here. Only high up, because tyres are as
    # short where they touch the ground.
    z = start[2] + (np.arange(counts[2]) + 0.5) * cell
    upper = z > 0.4 * extent[2]
    for side in sides:
        side[:, upper] = grey_opening(side[:, upper], (round(_THIN_M / cell), 1), mode="constant")
    close = round(_WHEEL_GAP_M / cell)
    sides = np.stack([grey_closing(side, close) for side in np.minimum(sides, reach[..., None])])
    sides = np.minimum(sides, reach[..., None])

    solid = sides.max(0) > 0.6 * sides.max((0, 2))[:, None]
    low = np.where(solid.any(1), z[solid.argmax(1)] - cell / 2, np.nan).clip(0.0)
    if not np.isfinite(low).any():
        raise no_body()
    low = np.interp(np.arange(len(low)), np.flatnonzero(np.isfinite(low)), low[np.isfinite(low)])
    under = -look(0, 1, 2, -1.0)
    middle = np.abs(y) < 0.3 * extent[1] / 2
    under = np.where(np.isfinite(under[:, middle]), under[:, middle], np.nan)
    floor = np.array([np.nanmedian(row) if np.isfinite(row).any() else np.nan for row in under])
    floor = np.where(np.isfinite(floor), floor, low)
    floor = median_filter(floor, round(_CLEAR_M / cell), mode="nearest")
    # In a mesh without a floor, the view from below reaches the roof.
    floor = np.minimum(floor, np.median(low) + 0.25)

    ends = start[0] + (np.flatnonzero(footprint.any(1))[[0, -1]] + [0, 1]) * cell
    front = look(1, 2, 0, 1.0)
    rear = -look(1, 2, 0, -1.0)
    front, rear = (np.where(np.isfinite(side), side.clip(*ends), np.nan) for side in (front, rear))
    return Hull(cell, start, top, sides, front, rear, low, floor)


def _between(
    rows: Float[np.ndarray, "N C"], at: Float[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Interpolates each row between two cells; infinite where one of the two is not finite."""
    left = np.floor(at).astype(np.int64).clip(0, rows.shape[1] - 2)
    row = np.arange(len(rows))
    low, high = rows[row, left], rows[row, left + 1]
    with np.errstate(invalid="ignore"):
        value = low + (at - left) * (high - low)
    return np.where(np.isfinite(low) & np.isfinite(high), value, np.inf)


@dataclass(frozen=True)
class Sections:
    """Outlines of the hull in planes across the long axis, around a point in y = 0.

    `station` is x of the planes, ascending, `axis_z` the height of the directions' origin, `radius`
    the distance to the hull. Direction i points at `-90 + i` degrees: down (0), left (90), up.
    """

    station: Float[np.ndarray, " S"]
    axis_z: Float[np.ndarray, " S"]
    radius: Float[np.ndarray, "S D"]
    low: Float[np.ndarray, " S"]
    floor: Float[np.ndarray, " S"]

    def points(self) -> tuple[Float[np.ndarray, "S D"], Float[np.ndarray, "S D"]]:
        """Returns y and z of the outlines."""
        direction = _directions()
        return self.radius * direction[:, 0], self.axis_z[:, None] + self.radius * direction[:, 1]


def _directions() -> Float[np.ndarray, "D 2"]:
    angle = np.radians(-90 + np.arange(DIRECTIONS))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def cut_sections(hull: Hull) -> Sections:
    """Cuts an outline for every x with cells, where rays from the axis last leave the hull."""
    count_y, count_z = hull.top.shape[1], hull.sides.shape[2]
    rows = np.flatnonzero(np.isfinite(hull.top).any(1) & (hull.sides.max((0, 2)) > 0.05))
    middle = np.abs(hull.start[1] + (np.arange(count_y) + 0.5) * hull.cell) < 0.12
    roof = np.where(np.isfinite(hull.top), hull.top, np.nan)[rows]
    some = [row[middle] if np.isfinite(row[middle]).any() else row for row in roof]
    height = np.array([np.nanmedian(row) for row in some])
    # Runs below a pickup's bed. Smoothed, as steps would shear the surface between two planes.
    axis_z = median_filter((height + hull.low[rows]) / 2, 9, mode="nearest")
    direction = _directions()
    reach = float(np.hypot(hull.sides.max(), count_z * hull.cell))
    steps = (np.arange(int(reach / hull.cell)) + 0.5) * hull.cell
    y = direction[:, :1] * steps
    right = np.broadcast_to((y < 0).astype(np.int64), y.shape)
    across = hull.index(y, 1, count_y)
    radius = np.empty((len(rows), DIRECTIONS))
    for index, row in enumerate(rows):
        z = axis_z[index] + direction[:, 1:] * steps
        up = hull.index(z, 2, count_z)
        inside = (
            (np.abs(y) <= hull.sides[right, row, up])
            & (z <= hull.top[row, across])
            & (z >= hull.low[row])
        )
        last = np.where(inside.any(1), len(steps) - 1 - inside[:, ::-1].argmax(1), 0)
        radius[index] = steps[last] + hull.cell / 2
    station = hull.start[0] + (rows + 0.5) * hull.cell
    return Sections(station, axis_z, radius, hull.low[rows], hull.floor[rows])
