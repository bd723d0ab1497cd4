"""Which triangle each sample sees: exact, for any number of triangles, the same code on CPU and GPU."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["Visibility", "face_areas", "rasterise"]

_NOTHING = torch.iinfo(torch.int64).max


@dataclass(frozen=True)
class Visibility:
    """What a grid of samples sees, `B` windows of `S x S` samples.

    Attributes:
        keys: `[B, S, S]` (depth, face) packed into one integer; the largest integer where nothing is.
        covered: `[K]` flat indices into `keys` of the samples that see a triangle.
        vehicle: `[K]` which vehicle each of them sees.
        face: `[K]` and which of its faces.
    """

    keys: Int[Tensor, "B S S"]
    covered: Int[Tensor, " K"]
    vehicle: Int[Tensor, " K"]
    face: Int[Tensor, " K"]

    def depth(self, sample: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Depth in metres at flat indices, to 0.01 mm; infinite where nothing is."""
        key = self.keys.view(-1)[sample]
        return torch.where(key == _NOTHING, torch.inf, ((key >> 32) - (1 << 30)).to(torch.get_default_dtype()) / 1e5)


def face_areas(screen: Float[Tensor, "N V 2"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "N F"]:
    """Twice the signed area of each projected triangle; positive where it shows its outside (image y points down)."""
    a, b, c = (screen[:, faces[:, corner]] for corner in range(3))
    return _cross(c - a, b - a)


@torch.no_grad()
def rasterise(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    window: Int[Tensor, " N"],
    window_count: int,
    size: int,
) -> Visibility:
    """Finds the nearest front-facing triangle at the centre of every sample.

    Every triangle's bounding box of samples is enumerated exactly, so there is no size limit and no padding; the
    nearest wins by one integer minimum over (depth, face).

    Args:
        screen: vertices in samples, relative to their window's top-left corner.
        depth: metres, smaller is nearer, magnitude below 10 km.
        faces: shared by all vehicles.
        window: the window each vehicle stands in.
        window_count: B.
        size: S, samples along a side.
    """
    areas = face_areas(screen, faces)
    vehicle, face = torch.nonzero(areas > 1e-12, as_tuple=True)
    corner_index = faces[face]
    corners = screen[vehicle[:, None], corner_index]
    low = (corners.amin(1) - 0.5).ceil().clamp(min=0).long()
    high = (corners.amax(1) - 0.5).floor().clamp(max=size - 1).long()
    extent = (high - low + 1).clamp(min=0)
    counts = extent.prod(1)

    # One row per (triangle, sample of its bounding box).
    row = torch.repeat_interleave(torch.arange(len(counts), device=screen.device), counts)
    offset = torch.arange(len(row), device=screen.device) - (counts.cumsum(0) - counts)[row]
    width = extent[row, 0]
    step_y = offset // width
    step_x = offset - step_y * width

    # Barycentric weights are affine in the sample's place; counted from the box's own corner, they keep their digits.
    corner_depth = depth[vehicle[:, None], corner_index]
    plane = _weight_planes(corners - low[:, None], areas[vehicle, face])[row]
    second = plane[:, 0] * step_x + plane[:, 1] * step_y + plane[:, 2]
    third = plane[:, 3] * step_x + plane[:, 4] * step_y + plane[:, 5]
    # A hair's breadth of tolerance closes the cracks that rounding opens between neighbours.
    inside = (second >= -1e-5) & (third >= -1e-5) & (second + third <= 1 + 1e-5)

    row = row[inside]
    x, y = low[row, 0] + step_x[inside], low[row, 1] + step_y[inside]
    near = corner_depth[row, 0]
    near = near + second[inside] * (corner_depth[row, 1] - near) + third[inside] * (corner_depth[row, 2] - near)
    quantised = (near * 1e5).round().long() + (1 << 30)
    key = (quantised << 32) | (vehicle * len(faces) + face)[row]
    sample = (window[vehicle[row]] * size + y) * size + x
    nearest = torch.full((window_count * size * size,), _NOTHING, dtype=torch.int64, device=screen.device)
    nearest.scatter_reduce_(0, sample, key, "amin")
    covered = torch.nonzero(nearest != _NOTHING)[:, 0]
    seen = nearest[covered] & 0xFFFFFFFF
    vehicle_seen = seen // len(faces)
    return Visibility(nearest.view(window_count, size, size), covered, vehicle_seen, seen - vehicle_seen * len(faces))


def _weight_planes(corners: Float[Tensor, "K 3 2"], area: Float[Tensor, " K"]) -> Float[Tensor, "K 6"]:
    """The weights of corners b and c at the centre of sample (i, j), each as (per i, per j, constant)."""
    a, b, c = corners.unbind(1)
    to_b, to_c = b - a, c - a
    # weight_b = cross(c - a, p - a) / area and weight_c = cross(p - a, b - a) / area, at p = (i + 0.5, j + 0.5).
    start = 0.5 - a
    planes = torch.stack(
        (-to_c[:, 1], to_c[:, 0], _cross(to_c, start), to_b[:, 1], -to_b[:, 0], _cross(start, to_b)), dim=1
    )
    return planes / area[:, None]


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
