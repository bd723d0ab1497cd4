"""Vehicles put into their scenes: where they fall in the picture and on the ground, and labels."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.geometry.rasterise import Visibility, rasterise
from skyproof.render.frames import Frames
from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import VehicleBatch


@dataclass(frozen=True)
class Windows:
    """One square of whole pixels per vehicle from its top-left pixel (x, y) on, all of one size."""

    origin: Int[Tensor, "N 2"]
    size: int

    def samples(self, screen: Float[Tensor, "N V 2"], factor: int) -> Float[Tensor, "N V 2"]:
        """Image pixels to samples of the window."""
        return (screen - self.origin[:, None].to(screen.dtype)) * factor


@torch.no_grad()
def windows_around(screen: Float[Tensor, "N V 2"]) -> Windows:
    """Windows that hold every vehicle's points with a pixel to spare."""
    low = screen.amin(1).floor() - 1
    high = screen.amax(1).ceil() + 1
    return Windows(low.long(), int((high - low).max()))


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


@torch.no_grad()
def visible_samples(
    placed: Placed, faces: Int[Tensor, "F 3"], supersampling: int
) -> tuple[Visibility, Windows]:
    """Returns the visible samples of each vehicle alone, and their windows, for `label`."""
    window = windows_around(placed.screen)
    samples = window.samples(placed.screen, supersampling)
    return rasterise(samples, placed.depth, faces, window.size * supersampling), window


@torch.no_grad()
def label(
    image: Float[Tensor, "B 3 H W"],
    placed: Placed,
    visibility: Visibility,
    window: Windows,
    supersampling: int,
    *,
    cover: Float[Tensor, "B 1 H W"] | None = None,
    masks: bool,
) -> Frames:
    """Adds boxes, centres, visible parts and, if wanted, masks to images of any renderer."""
    size_px = placed.size_px
    seen = None if cover is None else cover[placed.scene, 0] < 0.5
    visible_px, fraction, drawn = _visible(visibility, window, supersampling, size_px, seen, masks)
    corners = (placed.screen.amin(1), placed.screen.amax(1))
    boxes = torch.cat(corners, dim=1).clamp(0, size_px)
    extent = torch.stack((placed.vertices.amin(1), placed.vertices.amax(1)))
    centres, _ = project(extent.mean(0)[:, None], placed.viewer, placed.gsd_m, size_px)
    like = placed.vertices
    return Frames(
        image, placed.scene, boxes, centres[:, 0], visible_px.to(like), fraction.to(like), drawn
    )


def nothing_placed(image: Float[Tensor, "B 3 H W"], *, masks: bool) -> Frames:
    """Images of scenes without any vehicle."""
    nothing = image.new_zeros(0)
    drawn = image.new_zeros(0, *image.shape[2:]).bool() if masks else None
    scene = torch.zeros(0, dtype=torch.long, device=image.device)
    return Frames(image, scene, nothing.view(0, 4), nothing.view(0, 2), nothing, nothing, drawn)


def _visible(
    visibility: Visibility,
    window: Windows,
    factor: int,
    size_px: int,
    seen: Bool[Tensor, "N H W"] | None,
    masks: bool,
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"], Bool[Tensor, "N H W"] | None]:
    """Visible pixels, their share of all, and masks, of samples inside the image and `seen`."""
    count = len(visibility.keys)
    vehicle = visibility.vehicle
    every = torch.bincount(vehicle, minlength=count)
    end = window.origin + window.size
    if seen is None and not masks and bool((window.origin >= 0).all() & (end <= size_px).all()):
        return every.double() / factor**2, every.clamp(max=1).double(), None
    cell_x, cell_y = visibility.cells(factor)
    # Samples that are visible, of all.
    x = window.origin[:, 0].index_select(0, vehicle) + cell_x
    y = window.origin[:, 1].index_select(0, vehicle) + cell_y
    held = (x >= 0) & (x < size_px) & (y >= 0) & (y < size_px)
    if seen is not None:
        held &= seen[vehicle, y.clamp(0, size_px - 1), x.clamp(0, size_px - 1)]
    visible = torch.bincount(vehicle[held], minlength=count).double()
    drawn = None
    if masks:
        # A pixel belongs to the mask where at least half of its samples see the vehicle.
        cell = (vehicle * window.size + cell_y) * window.size + cell_x
        samples = torch.bincount(cell[held], minlength=count * window.size**2)
        samples = samples.view(count, window.size, window.size)
        owner, row, column = torch.nonzero(samples * 2 >= factor**2, as_tuple=True)
        drawn = torch.zeros(count, size_px, size_px, dtype=torch.bool, device=vehicle.device)
        drawn[owner, window.origin[owner, 1] + row, window.origin[owner, 0] + column] = True
    return visible / factor**2, visible / every.clamp(min=1).double(), drawn
