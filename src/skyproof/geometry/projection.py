"""The oblique orthophoto projection: the ground keeps its pixels, height displaces points."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotate_about_vertical(
    points: Float[Tensor, "N V 3"], angle_rad: Float[Tensor, " N"]
) -> Float[Tensor, "N V 3"]:
    """Turns each set of points counter-clockwise (from x towards y) about the z axis."""
    cosine = angle_rad.cos()[:, None]
    sine = angle_rad.sin()[:, None]
    x, y, z = points.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y, z), dim=-1)


def project(
    points: Float[Tensor, "N V 3"], direction: Float[Tensor, "N 3"], gsd_m: float, size_px: int
) -> tuple[Float[Tensor, "N V 2"], Float[Tensor, "N V"]]:
    """Projects world points along parallel rays onto the ground, and so onto the pixel grid.

    World points are in metres (x east, y north, z up) from the image centre. `direction` holds unit
    vectors towards the viewer, z > 0; if they point to the sun, the results are shadows. Pixels are
    counted from the top-left corner (x right, y down). Depth is in metres: smaller is nearer.
    """
    lean = (direction[:, :2] / direction[:, 2:])[:, None]
    ground = points[..., :2] - points[..., 2:] * lean
    flip = ground.new_tensor([1.0, -1.0]) / gsd_m
    depth = -(points * direction[:, None]).sum(-1)
    return ground * flip + size_px / 2, depth
