"""Which triangle each sample sees: exact, without padding, the same code on CPU and GPU."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["Visibility", "face_areas", "rasterise"]

_NOTHING = torch.iinfo(torch.int64).max
# A key holds depth in 0.01 mm above these bits, then the vehicle, then the face.
_FACE_BITS, _VEHICLE_BITS = 16, 15
_DEPTH_SHIFT, _DEPTH_ZERO = _FACE_BITS + _VEHICLE_BITS, 1 << 30


@dataclass(frozen=True)
class Visibility:
    """What a grid of samples sees: one window of `S x S` samples for each of `N` vehicles.

    Attributes:
        keys: `[N, S, S]` (depth, vehicle, face) packed into one integer; the largest integer where nothing is.
        covered: `[K]` flat indices into `keys` of the samples that see a triangle.
        x, y: `[K]` their places in their windows.
        vehicle: `[K]` which vehicle each of them sees.
        face: `[K]` and which of its faces.
    """

    keys: Int[Tensor, "N S S"]
    covered: Int[Tensor, " K"]
    x: Int[Tensor, " K"]
    y: Int[Tensor, " K"]
    vehicle: Int[Tensor, " K"]
    face: Int[Tensor, " K"]

    def depth(self, sample: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Depth in metres at flat indices, to 0.01 mm; infinite where nothing is."""
        key = self.keys.view(-1)[sample]
        return torch.where(
            key == _NOTHING, torch.inf, ((key >> _DEPTH_SHIFT) - _DEPTH_ZERO).double() / 1e5
        )


def face_areas(screen: Float[Tensor, "N V 2"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "N F"]:
    """Twice the signed area of each projected triangle; positive where it shows its outside (image y points down)."""
    a, b, c = (screen[:, faces[:, corner]] for corner in range(3))
    return _cross(c - a, b - a)


@torch.no_grad()
def rasterise(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    size: int,
) -> Visibility:
    """Finds the nearest front-facing triangle at the centre of every sample.

    Every triangle is cut into the rows of samples it crosses, every row into the samples between its two edges; the
    nearest triangle wins by one integer minimum over (depth, vehicle, face).

    Args:
        screen: vertices in samples, relative to the top-left corner of their own window.
        depth: metres, smaller is nearer, magnitude below 10 km.
        faces: shared by all vehicles.
        size: S, samples along a side.
    """
    if len(faces) >= 1 << _FACE_BITS or len(screen) >= 1 << _VEHICLE_BITS:
        raise ValueError(
            f"expected fewer than 65536 faces and 32768 vehicles, got {len(faces)} and {len(screen)}"
        )
    areas = face_areas(screen, faces)
    vehicle, face = torch.nonzero(areas > 1e-12, as_tuple=True)
    # Row look-ups by `index_select` are about twice as fast as indexing here.
    corner = (vehicle[:, None] * screen.shape[1] + faces.index_select(0, face)).flatten()
    corners = screen.flatten(0, 1).index_select(0, corner).view(-1, 3, 2)
    corner_depth = depth.flatten().index_select(0, corner).view(-1, 3)
    # Counted from a whole sample near the triangle, coordinates keep their digits.
    low, high = corners.amin(1), corners.amax(1)
    base = low.floor()
    planes, depth_plane = _planes(corners - base[:, None], corner_depth, areas[vehicle, face])
    x_base, y_base = base.long().unbind(1)

    low_y = (low[:, 1] - 0.5).ceil().long().clamp(min=0)
    high_y = (high[:, 1] - 0.5).floor().long().clamp(max=size - 1)
    row, step = _enumerate((high_y - low_y + 1).clamp(min=0))
    # Per row of a triangle: y, counted from the triangle's base, and the ends of the span of x, likewise.
    y_step = (low_y - y_base).index_select(0, row) + step
    span_low, span_high = _span(planes.index_select(0, row), y_step.to(screen.dtype))
    offset = x_base.index_select(0, row)
    low_x = torch.maximum(span_low.ceil().long(), -offset)
    high_x = torch.minimum(span_high.floor().long(), size - 1 - offset)
    # What a span's samples share: their place at x step 0, and the part of depth and key that does not change.
    place = ((vehicle * size + y_base) * size + x_base).index_select(0, row) + y_step * size
    slope = depth_plane.index_select(0, row)
    start = torch.addcmul(slope[:, 2], slope[:, 1], y_step.to(screen.dtype))
    label = ((vehicle << _FACE_BITS) | face).index_select(0, row)

    span, step = _enumerate((high_x - low_x + 1).clamp(min=0))
    x_step = low_x.index_select(0, span) + step
    rise = slope[:, 0].contiguous().index_select(0, span)
    near = torch.addcmul(start.index_select(0, span), rise, x_step.to(screen.dtype))
    key = (near.double() * 1e5).round().long() + _DEPTH_ZERO
    key = (key << _DEPTH_SHIFT) | label.index_select(0, span)
    sample = place.index_select(0, span) + x_step
    nearest = torch.full(
        (len(screen) * size * size,), _NOTHING, dtype=torch.int64, device=screen.device
    )
    nearest.scatter_reduce_(0, sample, key, "amin")
    covered = torch.nonzero(nearest != _NOTHING)[:, 0]
    seen = nearest[covered]
    vehicle_seen = (seen >> _FACE_BITS) & ((1 << _VEHICLE_BITS) - 1)
    row = covered // size
    return Visibility(
        keys=nearest.view(len(screen), size, size),
        covered=covered,
        x=covered - row * size,
        y=row - vehicle_seen * size,
        vehicle=vehicle_seen,
        face=seen & ((1 << _FACE_BITS) - 1),
    )


def _enumerate(counts: Int[Tensor, " K"]) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """For counts (2, 0, 3): rows (0, 0, 2, 2, 2) and steps (0, 1, 0, 1, 2)."""
    row = torch.repeat_interleave(counts)
    step = torch.arange(len(row), device=counts.device) - (counts.cumsum(0) - counts).index_select(
        0, row
    )
    return row, step


def _planes(
    corners: Float[Tensor, "K 3 2"], depth: Float[Tensor, "K 3"], area: Float[Tensor, " K"]
) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3"]]:
    """The three barycentric weights, and the depth, at the centre of sample (i, j): (per i, per j, constant)."""
    a, b, c = corners.unbind(1)
    to_b, to_c, start = b - a, c - a, 0.5 - a
    # weight_b = cross(c - a, p - a) / area and weight_c = cross(p - a, b - a) / area, at p = (i + 0.5, j + 0.5).
    second = torch.stack((-to_c[:, 1], to_c[:, 0], _cross(to_c, start)), dim=1) / area[:, None]
    third = torch.stack((to_b[:, 1], -to_b[:, 0], _cross(start, to_b)), dim=1) / area[:, None]
    first = -second - third
    first[:, 2] += 1
    rise = depth[:, 1:] - depth[:, :1]
    slope = second * rise[:, :1] + third * rise[:, 1:]
    slope[:, 2] += depth[:, 0]
    return torch.stack((first, second, third), dim=1), slope


def _span(
    planes: Float[Tensor, "R 3 3"], row: Float[Tensor, " R"]
) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
    """Between which i all three weights are positive in a row of samples; empty spans have low > high."""
    per_i = planes[..., 0]
    # A hair's breadth of tolerance closes the cracks that rounding opens between neighbours.
    rest = planes[..., 1] * row[:, None] + planes[..., 2] + 1e-5
    bound = -rest / per_i
    low = torch.where(per_i > 0, bound, -torch.inf)
    high = torch.where(per_i < 0, bound, torch.inf)
    never = ((per_i == 0) & (rest < 0)).any(1)
    return torch.where(never, torch.inf, low.amax(1)).clamp(-1e6, 1e6), high.amin(1).clamp(
        -1e6, 1e6
    )


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
