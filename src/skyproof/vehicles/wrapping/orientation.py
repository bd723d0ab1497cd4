"""Puts a mesh into the vehicle's axes: metres, nose along +x, left along +y, standing on z = 0."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from skyproof.errors import ConfigurationError
from skyproof.vehicles.wrapping.meshes import SourceMesh

# Lengths, widths and heights of road vehicles from a small car to a coach, with and without
# mirrors.
_SMALLEST_M, _LARGEST_M = (2.4, 1.2, 0.9), (15.0, 3.8, 4.5)
_USUAL_UNITS = (1.0, 0.0254, 0.01, 0.001, 0.1, 0.3048)
_USUAL_LENGTH_M = 4.5
_MOST_POINTS = 20_000_000


def orient(
    mesh: SourceMesh,
    *,
    scale: float | None = None,
    up: str | None = None,
    forward: str | None = None,
) -> tuple[SourceMesh, dict[str, str | float]]:
    """Turns, scales and moves a mesh.

    The scale is in metres per unit, 1 by default. `up` and `forward` (towards the nose) are each an
    `Axis`. Missing ones come from the format or are guessed: forward is the longest axis other than
    up, and up the less symmetric of the two shorter axes, in its positive direction.
    `_nose_is_first` finds the nose.

    Returns:
        The mesh in the vehicle's axes, and {"scale", "up", "forward", "nose": how it was found}.
    """
    points = mesh.corners.reshape(-1, 3)
    extent = np.ptp(points, axis=0)
    up = up or mesh.up or _guess_up(points)
    across = [axis for axis in range(3) if axis != _axis(up)[0]]
    guessed = forward is None
    forward = forward or "xyz"[max(across, key=lambda axis: extent[axis])]
    if _axis(up)[0] == _axis(forward)[0]:
        raise ConfigurationError(
            f"--wrapping.up {up} and --wrapping.forward {forward} lie along one axis; give two "
            "different ones."
        )
    unit_m = scale if scale is not None else 1.0
    turned = _turn(mesh.corners, up, forward) * unit_m
    _check_size(np.ptp(turned.reshape(-1, 3), axis=0), unit_m)
    first, how = _nose_is_first(turned) if guessed else (True, "as given")
    if not first:
        forward = forward.removeprefix("-") if forward.startswith("-") else f"-{forward}"
        turned = turned * [-1.0, -1.0, 1.0]
    flat = turned.reshape(-1, 3)
    low = flat.min(0)
    high = flat.max(0)
    turned = turned - [(low[0] + high[0]) / 2, _middle_y(flat), low[2]]
    facts: dict[str, str | float] = {"scale": unit_m, "up": up, "forward": forward, "nose": how}
    return replace(mesh, corners=turned), facts


def _axis(name: str) -> tuple[int, float]:
    return "xyz".index(name[-1]), -1.0 if name.startswith("-") else 1.0


def _turn(corners: Float[np.ndarray, "F 3 3"], up: str, forward: str) -> Float[np.ndarray, "F 3 3"]:
    rows = np.zeros((3, 3))
    for row, name in ((0, forward), (2, up)):
        axis, sign = _axis(name)
        rows[row, axis] = sign
    rows[1] = np.cross(rows[2], rows[0])
    return corners @ rows.T


def _middle_y(points: Float[np.ndarray, "N 3"]) -> float:
    """Finds the plane of best symmetry, so that a door mirror on one side alone has no effect."""
    sample = points[:: max(len(points) // 6000, 1)]
    middle = (sample[:, 1].min() + sample[:, 1].max()) / 2
    shifts = middle + np.linspace(-0.12, 0.12, 49)
    tree = cKDTree(sample)
    costs = [
        np.minimum(tree.query(sample * [1, -1, 1] + [0, 2 * y, 0])[0], 0.1).mean() for y in shifts
    ]
    best = int(np.argmin(costs))
    return float(shifts[best] if costs[best] < costs[24] - 1e-4 else middle)


def _guess_up(points: Float[np.ndarray, "N 3"]) -> str:
    """Returns the one of the two shorter axes along which the mesh is less symmetric."""
    extent = np.ptp(points, axis=0)
    sample = points[:: max(len(points) // 4000, 1)]
    tree = cKDTree(sample)
    misfit = []
    shorter = [axis for axis in range(3) if axis != int(extent.argmax())]
    for axis in shorter:
        image = sample.copy()
        image[:, axis] = points[:, axis].min() + points[:, axis].max() - image[:, axis]
        misfit.append(tree.query(image)[0].mean())
    return "xyz"[shorter[int(np.argmax(misfit))]]


def _fits(extent_m: Float[np.ndarray, " 3"]) -> bool:
    return bool(((extent_m >= _SMALLEST_M) & (extent_m <= _LARGEST_M)).all())


def _check_size(extent_m: Float[np.ndarray, " 3"], unit_m: float) -> None:
    """Refuses a mesh without a vehicle's size, and names a scale that would fit."""
    if _fits(extent_m):
        return
    size = " x ".join(f"{value:.3g}" for value in extent_m)
    fitting = [unit for unit in _USUAL_UNITS if _fits(extent_m * unit / unit_m)]
    scale = min(
        fitting,
        key=lambda unit: abs(np.log(extent_m[0] * unit / unit_m / _USUAL_LENGTH_M)),
        default=unit_m * _USUAL_LENGTH_M / extent_m[0],
    )
    raise ConfigurationError(
        f"The mesh measures {size} m (length, width, height), not a vehicle's size; give "
        f"--wrapping.scale (--wrapping.scale {scale:.4g} would make it "
        f"{extent_m[0] * scale / unit_m:.2f} m long), or --wrapping.up and --wrapping.forward if "
        "it lies otherwise."
    )


def _nose_is_first(corners: Float[np.ndarray, "F 3 3"]) -> tuple[bool, str]:
    """Says whether +x is the nose, and what shows it: windscreen, bonnet, mirrors, or nothing.

    1. Between 75 and 85 % of the height the nose's end slopes at least twice as far: the
       windscreen. 2. Otherwise the distance from the end to where the vehicle reaches 85 % of its
       height is longer at the nose: bonnet and windscreen against boot and rear window.
       3. Otherwise mirrors, which protrude by more than 5 cm, are in the front half.
    """
    points = _spread(corners)
    low = points[:, 0].min()
    high = points[:, 0].max()
    length = high - low
    height = points[:, 2].max() - points[:, 2].min()
    at = np.clip(((points[:, 0] - low) / length * 200).astype(int), 0, 199)
    top = np.full(200, -np.inf)
    wide = np.zeros(200)
    np.maximum.at(top, at, points[:, 2] - points[:, 2].min())
    np.maximum.at(wide, at, np.abs(points[:, 1] - np.median(points[:, 1])))

    def ways(profile: np.ndarray) -> tuple[float, float]:
        reach = [int(np.argmax(profile >= share * height)) / 200 * length for share in (0.75, 0.85)]
        return reach[1], reach[1] - reach[0]

    front, front_run = ways(top[::-1])
    rear, rear_run = ways(top)
    if max(front_run, rear_run) > 2 * min(front_run, rear_run) + 0.05:
        return bool(front_run > rear_run), "the windscreen slopes more than the rear"
    if max(front, rear) > 1.2 * min(front, rear) + 0.15:
        return bool(front > rear), "bonnet and windscreen are longer than boot and rear window"
    out = np.flatnonzero(wide > np.median(wide) + 0.05)
    if len(out) and abs(out.mean() - 99.5) > 20:
        return bool(out.mean() > 99.5), "the mirrors are in front"
    return True, "nothing tells nose from tail: check it, and give --wrapping.forward"


def _spread(corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Spreads points over the triangles: 78 on each, or fewer if there are very many triangles."""
    side = next(
        (side for side in range(12, 2, -1) if side * (side + 1) // 2 * len(corners) < _MOST_POINTS),
        2,
    )
    steps = np.linspace(0.0, 1.0, side)
    u, v = np.meshgrid(steps, steps)
    inside = u + v <= 1.0
    u, v = u[inside], v[inside]
    weights = np.stack([1 - u - v, u, v], axis=-1)
    return np.einsum("wk,fkc->fwc", weights, corners).reshape(-1, 3)
