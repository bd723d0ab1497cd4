"""Finds the triangle that each sample sees: exact, without padding, the same on CPU and GPU."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import at_corners

_NOTHING = torch.iinfo(torch.int64).max
# A key holds the depth in 0.01 mm above these bits, and the face in them.
_FACE_BITS = 31
_DEPTH_ZERO = 1 << 30
# Triangles are drawn in parts of this size, to bound the memory of a large mesh.
_TRIANGLES = 1 << 17


class Visibility:
    """The view of a grid of samples: one window of `S x S` samples for each of `N` bodies.

    `keys` hold depth and face in one integer, the largest one where a sample is empty. `covered`
    are flat indices of the others, of which column, row, window and visible face follow.
    """

    def __init__(self, keys: Int[Tensor, "N S S"]) -> None:
        self.keys = keys
        size = keys.shape[-1]
        flat = keys.view(-1)
        self.covered: Int[Tensor, " K"] = torch.nonzero(flat != _NOTHING)[:, 0]
        row = self.covered // size
        self.x: Int[Tensor, " K"] = self.covered - row * size
        of_row = torch.arange(len(keys) * size, device=keys.device) // size
        self.vehicle: Int[Tensor, " K"] = of_row.index_select(0, row)
        self.y: Int[Tensor, " K"] = row - self.vehicle * size
        self.face: Int[Tensor, " K"] = flat.index_select(0, self.covered) & ((1 << _FACE_BITS) - 1)

    def cells(self, factor: int) -> tuple[Int[Tensor, " K"], Int[Tensor, " K"]]:
        """Column and row of each sample's cell of `factor` samples."""
        # Look-ups are faster than divisions.
        cell = torch.arange(self.keys.shape[-1], device=self.x.device) // factor
        return cell.index_select(0, self.x), cell.index_select(0, self.y)

    def find(self, sample: Int[Tensor, " M"]) -> Int[Tensor, " M"]:
        """Returns the indices of samples (flat indices into `keys`) in `covered`; K if empty."""
        place = torch.searchsorted(self.covered, sample)
        padded = torch.nn.functional.pad(self.covered, (0, 1), value=-1)
        return torch.where(padded.index_select(0, place) == sample, place, len(self.covered))

    def depth(self, sample: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Returns depth in metres at flat indices, to 0.01 mm; infinite for empty samples."""
        key = self.keys.view(-1).index_select(0, sample)
        depth = ((key >> _FACE_BITS) - _DEPTH_ZERO).double() / 1e5
        return torch.where(key == _NOTHING, torch.inf, depth)


def face_areas(corners: Float[Tensor, "3 2 M"]) -> Float[Tensor, " M"]:
    """Twice the signed area of each projected triangle, positive if it shows its outside."""
    a, b, c = corners
    return cross(c - a, b - a)


def barycentric(
    corners: Float[Tensor, "3 2 K"], point: Float[Tensor, "2 K"]
) -> Float[Tensor, "3 K"]:
    """Returns the weights of a triangle's three corners at a point; differentiable in both."""
    a, b, c = corners
    to_b, to_c, to_point = b - a, c - a, point - a
    area = cross(to_c, to_b)
    second = cross(to_c, to_point) / area
    third = cross(to_point, to_b) / area
    return torch.stack((1 - second - third, second, third))


@torch.no_grad()
def rasterise(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    size: int,
    *,
    two_sided: bool = False,
) -> Visibility:
    """Finds the nearest triangle at the centre of every sample.

    Triangles are cut into the rows of samples they cross, rows into the samples between two edges.
    One integer minimum over (depth, face) finds the nearest triangle. At equal depth, to 0.01 mm,
    the first face wins.

    Vertices lie in samples from the top-left corner of their own `size` x `size` window; depths are
    metres, smaller is nearer, magnitude below 10 km. With `two_sided` triangles that show their
    inside are drawn, too, as open meshes need.
    """
    if len(faces) >= 1 << _FACE_BITS:
        raise ValueError(f"expected fewer than {1 << _FACE_BITS} faces, got {len(faces)}")
    corners = at_corners(screen, faces)
    corner_depth = at_corners(depth[..., None], faces)[:, 0]
    areas = face_areas(corners)
    shown = torch.nonzero(areas.abs() > 1e-12 if two_sided else areas > 1e-12)[:, 0]
    samples = len(screen) * size * size
    keys = torch.full((samples,), _NOTHING, dtype=torch.int64, device=screen.device)
    for part in shown.split(_TRIANGLES):
        vehicle = part // len(faces)
        _draw(
            keys,
            corners.flatten(0, 1).index_select(1, part).view(3, 2, -1),
            corner_depth.index_select(1, part),
            areas.index_select(0, part),
            vehicle,
            part - vehicle * len(faces),
            size,
        )
    return Visibility(keys.view(len(screen), size, size))


def _draw(
    keys: Int[Tensor, " M"],
    corners: Float[Tensor, "3 2 T"],
    corner_depth: Float[Tensor, "3 T"],
    area: Float[Tensor, " T"],
    vehicle: Int[Tensor, " T"],
    face: Int[Tensor, " T"],
    size: int,
) -> None:
    """Lowers `keys` to the triangles `face` of the bodies `vehicle` that are nearer."""
    # Coordinates relative to a whole sample near the triangle keep their digits.
    low = corners.amin(0)
    high = corners.amax(0)
    base = low.floor()
    planes, depth_plane = _planes(corners - base, corner_depth, area)
    x_base, y_base = base.long()

    # Triangles to rows: y, counted from the triangle's base, and the ends of the span of x.
    low_y = (low[1] - 0.5).ceil().long().clamp(min=0)
    high_y = (high[1] - 0.5).floor().long().clamp(max=size - 1)
    row, step = enumerate_counts((high_y - low_y + 1).clamp(min=0))
    y_step = (low_y - y_base).index_select(0, row) + step
    per_row = planes.flatten(0, 1).index_select(1, row).view(3, 3, -1)
    span_low, span_high = _span(per_row, y_step.to(corners.dtype))
    offset = x_base.index_select(0, row)
    low_x = torch.maximum(span_low.ceil().long(), -offset)
    high_x = torch.minimum(span_high.floor().long(), size - 1 - offset)
    # The samples of a row share their place at x step 0, and the depth there.
    place = ((vehicle * size + y_base) * size + x_base).index_select(0, row) + y_step * size
    slope = depth_plane.index_select(1, row)
    start = torch.addcmul(slope[2], slope[1], y_step.to(corners.dtype))
    label = face.index_select(0, row)

    span, step = enumerate_counts((high_x - low_x + 1).clamp(min=0))
    x_step = low_x.index_select(0, span) + step
    rise = slope[0].index_select(0, span)
    near = torch.addcmul(start.index_select(0, span), rise, x_step.to(corners.dtype))
    key = (near.double() * 1e5).round().long() + _DEPTH_ZERO
    key = (key << _FACE_BITS) | label.index_select(0, span)
    keys.scatter_reduce_(0, place.index_select(0, span) + x_step, key, "amin")


def enumerate_counts(counts: Int[Tensor, " K"]) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Returns rows and steps: for counts (2, 0, 3) rows (0, 0, 2, 2, 2), steps (0, 1, 0, 1, 2)."""
    row = torch.repeat_interleave(counts)
    before = (counts.cumsum(0) - counts).index_select(0, row)
    return row, torch.arange(len(row), device=counts.device) - before


def _planes(
    corners: Float[Tensor, "3 2 K"], depth: Float[Tensor, "3 K"], area: Float[Tensor, " K"]
) -> tuple[Float[Tensor, "3 3 K"], Float[Tensor, "3 K"]]:
    """The three weights and the depth as planes over samples (i, j): per i, per j, constant."""
    a, b, c = corners
    to_b, to_c, start = b - a, c - a, 0.5 - a
    # weight_b = cross(c - a, p - a) / area and weight_c = cross(p - a, b - a) / area, at the
    # point p = (i + 0.5, j + 0.5).
    second = torch.stack((-to_c[1], to_c[0], cross(to_c, start))) / area
    third = torch.stack((to_b[1], -to_b[0], cross(start, to_b))) / area
    first = -second - third
    first[2] += 1
    slope = second * (depth[1] - depth[0]) + third * (depth[2] - depth[0])
    slope[2] += depth[0]
    return torch.stack((first, second, third)), slope


def _span(
    planes: Float[Tensor, "3 3 R"], row: Float[Tensor, " R"]
) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
    """The range of i with three positive weights in a row of samples; low > high if empty."""
    per_i, per_j, constant = planes.unbind(1)
    # A tiny tolerance closes the cracks that rounding opens between neighbours.
    rest = per_j * row + constant + 1e-5
    bound = -rest / per_i
    low = torch.where(per_i > 0, bound, -torch.inf).amax(0)
    high = torch.where(per_i < 0, bound, torch.inf).amin(0)
    never = ((per_i == 0) & (rest < 0)).any(0)
    low = torch.where(never, torch.inf, low)
    return low.clamp(-1e6, 1e6), high.clamp(-1e6, 1e6)


def cross(first: Float[Tensor, "2 K"], second: Float[Tensor, "2 K"]) -> Float[Tensor, " K"]:
    """Returns the cross products of vectors in the plane."""
    return first[0] * second[1] - first[1] * second[0]
