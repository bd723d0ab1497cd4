"""Finds the triangle that each sample sees: exact, without padding, the same on CPU and GPU."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.triangles import FACE_BITS, NOTHING_KEY, draw_triangles
from skyproof.kernels import launch


@torch.no_grad()
def rasterise(
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    faces: Int[Tensor, "F 3"],
    size: int,
    *,
    two_sided: bool = False,
) -> Int[Tensor, "N S S"]:
    """Finds the nearest triangle at the centre of every sample, in a window for each of N bodies.

    Triangles are cut into the rows of samples they cross, rows into the samples between two edges.
    One integer minimum over (depth, face) finds the nearest triangle. At equal depth, to 0.01 mm,
    the first face wins.

    Vertices lie in samples from the top-left corner of their own `size` x `size` window; depths are
    metres, smaller is nearer, magnitude below 10 km. With `two_sided`, triangles seen
    from inside are drawn, too, as open meshes need.

    Returns:
        Keys that hold depth and face in one integer, `NOTHING_KEY` where a sample is empty.
    """
    keys = torch.full((len(screen), size, size), NOTHING_KEY, device=screen.device)
    seen = (screen.float().contiguous(), depth.float().contiguous(), faces.int().contiguous())
    launch(draw_triangles, (len(screen), len(faces)), *seen, two_sided, keys)
    return keys


def visible_faces(keys: Int[Tensor, "N S S"]) -> Int[Tensor, "N S S"]:
    """Returns each sample's visible face; -1 where it is empty."""
    return torch.where(keys == NOTHING_KEY, -1, keys & ((1 << FACE_BITS) - 1))
