"""Places vehicles in their scenes: where they are in the picture and on the ground, and labels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.errors import NotFiniteError
from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.geometry.rasterise import rasterise
from skyproof.geometry.triangles import NOTHING_KEY
from skyproof.render.frames import Frames
from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import VehicleBatch


@dataclass(frozen=True)
class Windows:
    """A square of whole pixels per vehicle, all of one size; `origin` is its top-left (x, y)."""

    origin: Int[Tensor, "N 2"]
    size: int

    def samples(self, screen: Float[Tensor, "N V 2"], factor: int) -> Float[Tensor, "N V 2"]:
        """Converts image pixels to samples of the window."""
        return (screen - self.origin[:, None].to(screen.dtype)) * factor


@torch.no_grad()
def windows_around(screen: Float[Tensor, "N V 2"]) -> Windows:
    """Returns windows that hold every vehicle's points with a pixel to spare.

    Raises:
        NotFiniteError: a point is no number, or infinite.
    """
    low = screen.amin(1).floor() - 1
    high = screen.amax(1).ceil() + 1
    widest = float((high - low).max())
    if not math.isfinite(widest):
        broken = int((~screen.isfinite()).flatten(1).any(1).sum())
        raise NotFiniteError(
            f"Vehicles need vertices that are finite numbers, but {broken} of {len(screen)} have "
            "others and cannot be drawn; lower the learning rate of their shape, or give other "
            "vehicles."
        )
    return Windows(low.long(), int(widest))


@dataclass(frozen=True)
class Placed:
    """The N placements of all scenes, scene by scene; differentiable in the vehicles' vertices.

    World frame, metres, radians and image pixels; `extent` is in the vehicle frame. `viewer` and
    `sun` point towards camera and sun, along whose rays depths are measured; smaller is nearer.
    `sunlit` is the share of the direct sun that the photograph's shadows leave.
    """

    scene: Int[Tensor, " N"]
    vertices: Float[Tensor, "N V 3"]
    viewer: Float[Tensor, "N 3"]
    sun: Float[Tensor, "N 3"]
    ground: Float[Tensor, "N 3"]
    heading: Float[Tensor, " N"]
    extent: Float[Tensor, "N 2 3"]
    sunlit: Float[Tensor, " N"]
    screen: Float[Tensor, "N V 2"]
    depth: Float[Tensor, "N V"]
    shadow_screen: Float[Tensor, "N V 2"]
    sun_depth: Float[Tensor, "N V"]
    gsd_m: float
    size_px: int


def place(scenes: Sequence[Scene], vehicles: VehicleBatch) -> Placed:
    """Puts vehicles where their scenes' placements say, one row per placement, scene by scene."""
    placements = [placement for scene in scenes for placement in scene.placements]
    if len(placements) != len(vehicles):
        raise ValueError(
            f"expected {len(placements)} vehicles, one per placement, got {len(vehicles)}"
        )
    camera, like = scenes[0].camera, vehicles.vertices
    scene = torch.tensor(
        [i for i, each in enumerate(scenes) for _ in each.placements], device=like.device
    )
    viewer = like.new_tensor([picture.camera.direction for picture in scenes])[scene]
    sun = like.new_tensor([picture.sun.direction for picture in scenes])[scene]
    ground = like.new_tensor([[placement.x_m, placement.y_m, 0.0] for placement in placements])
    heading = like.new_tensor([placement.heading_rad for placement in placements])
    vertices = rotate_about_vertical(like, heading) + ground[:, None]
    screen, depth = project(vertices, viewer, camera.gsd_m, camera.size_px)
    shadow_screen, sun_depth = project(vertices, sun, camera.gsd_m, camera.size_px)
    extent = torch.stack((like.amin(1), like.amax(1)), dim=1)
    sunlit = 1 - like.new_tensor([placement.shade for placement in placements])
    where = (scene, vertices, viewer, sun, ground, heading, extent, sunlit)
    shown = (screen, depth, shadow_screen, sun_depth)
    return Placed(*where, *shown, gsd_m=camera.gsd_m, size_px=camera.size_px)


def nothing_placed(image: Float[Tensor, "B 3 H W"], *, masks: bool) -> Frames:
    """Returns frames of scenes without any vehicle."""
    nothing = image.new_zeros(0)
    drawn = image.new_zeros(0, *image.shape[2:]).bool() if masks else None
    scene = torch.zeros(0, dtype=torch.long, device=image.device)
    return Frames(image, scene, nothing.view(0, 4), nothing.view(0, 2), nothing, nothing, drawn)


@torch.no_grad()
def coverage_of(
    placed: Placed, faces: Int[Tensor, "F 3"], supersampling: int
) -> tuple[Float[Tensor, "N S S"], Windows]:
    """Returns the share of each pixel that each vehicle alone covers, for `label`."""
    window = windows_around(placed.screen)
    samples = window.samples(placed.screen, supersampling)
    keys = rasterise(samples, placed.depth, faces, window.size * supersampling)
    covered = (keys != NOTHING_KEY).float()
    return torch.nn.functional.avg_pool2d(covered, supersampling), window


@torch.no_grad()
def label(
    image: Float[Tensor, "B 3 H W"],
    placed: Placed,
    coverage: Float[Tensor, "N S S"],
    window: Windows,
    *,
    cover: Float[Tensor, "B 1 H W"] | None = None,
    masks: bool,
) -> Frames:
    """Adds boxes, centres, visible parts and, if wanted, masks to images of any renderer."""
    size_px = placed.size_px
    steps = torch.arange(window.size, device=image.device)
    x, y = window.origin[:, :1] + steps, window.origin[:, 1:] + steps
    held = ((y >= 0) & (y < size_px))[:, :, None] & ((x >= 0) & (x < size_px))[:, None]
    if cover is not None:
        row, column = y.clamp(0, size_px - 1)[:, :, None], x.clamp(0, size_px - 1)[:, None]
        held &= cover[placed.scene[:, None, None], 0, row, column] < 0.5
    seen = coverage * held
    drawn = None
    if masks:
        # A pixel belongs to the mask where at least half of its samples see the vehicle.
        owner, row, column = torch.nonzero(seen >= 0.5, as_tuple=True)
        drawn = torch.zeros(len(x), size_px, size_px, dtype=torch.bool, device=image.device)
        drawn[owner, y[owner, row], x[owner, column]] = True
    visible_px, every_px = seen.sum((1, 2)).double(), coverage.sum((1, 2)).double()
    fraction = visible_px / every_px.masked_fill(every_px == 0, 1.0)
    boxes = torch.cat((placed.screen.amin(1), placed.screen.amax(1)), dim=1).clamp(0, size_px)
    extent = torch.stack((placed.vertices.amin(1), placed.vertices.amax(1)))
    centres, _ = project(extent.mean(0)[:, None], placed.viewer, placed.gsd_m, size_px)
    like = placed.vertices
    shown = (boxes, centres[:, 0], visible_px.to(like), fraction.to(like))
    return Frames(image, placed.scene, *shown, drawn)
