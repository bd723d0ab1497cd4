"""The differentiable renderer: vehicles onto orthophotos, in plain PyTorch (PAPER 10-14)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.render.composite import composite
from skyproof.render.frames import Frames
from skyproof.render.layers import Windows, draw_bodies, draw_shadows, windows_around
from skyproof.render.rasterise import Visibility
from skyproof.render.settings import RenderSettings
from skyproof.render.weather import finish_images, sky_shares, wet_grounds
from skyproof.scenes.scene import BackgroundWindow, Scene
from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["Backgrounds", "TorchRenderer"]


@runtime_checkable
class Backgrounds(Protocol):
    """Where the renderer takes its photographs from."""

    def window(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "3 H W"]:
        """A square window, sRGB in [0, 1]."""
        ...


class TorchRenderer:
    """Draws vehicles onto photographs, differentiably in their texture and their vertices.

    Every vehicle and its shadow are rendered in small windows of their own, at `supersampling` samples a pixel side,
    shaded by sun and sky, averaged to pixels, blurred, and laid over the photograph in linear light (PAPER 11, 12).

    Differences from the paper: the camera is the orthophoto's own parallel projection (see `Camera`), not a
    perspective one at a distance that the paper does not give; there is a cast shadow; light adds up linearly; the
    photograph is hidden by blurred coverage (see `composite`); noise is added where something was rendered; a scene's
    weather changes light, ground and picture (see `skyproof.render.weather`).

    Vertex gradients hold for a fixed set of visible triangles plus moving silhouettes, of the body and of its shadow.
    Vehicles cast no shadow on themselves or on each other; masks and visible pixels ignore that one may hide another.
    """

    differentiable = True

    def __init__(self, backgrounds: Backgrounds, settings: RenderSettings | None = None) -> None:
        self.backgrounds = backgrounds
        self.settings = settings or RenderSettings()

    def photographs(self, scenes: Sequence[Scene], device: torch.device) -> Float[Tensor, "B 3 H W"]:
        """The scenes' photographs without vehicles."""
        windows = [self.backgrounds.window(scene.background, scene.camera.size_px) for scene in scenes]
        return torch.stack(windows).to(device)

    def __call__(self, scenes: Sequence[Scene], vehicles: VehicleBatch, *, masks: bool = False) -> Frames:
        """Draws one image per scene.

        Args:
            scenes: all of one image size and ground sampling distance.
            vehicles: one row per placement, scene by scene.
            masks: also give every vehicle's pixel mask.
        """
        placements = [placement for scene in scenes for placement in scene.placements]
        if len(placements) != len(vehicles):
            raise ValueError(f"expected {len(placements)} vehicles, one per placement, got {len(vehicles)}")
        device = vehicles.vertices.device
        photographs = wet_grounds(self.photographs(scenes, device), scenes)
        if not placements:
            nothing = photographs.new_zeros(0)
            empty_masks = photographs.new_zeros(0, *photographs.shape[2:]).bool() if masks else None
            return Frames(
                finish_images(photographs, scenes),
                torch.zeros(0, dtype=torch.long, device=device),
                nothing.view(0, 4),
                nothing.view(0, 2),
                nothing,
                nothing,
                empty_masks,
            )
        camera, settings = scenes[0].camera, self.settings
        like = vehicles.vertices
        scene = torch.tensor([i for i, each in enumerate(scenes) for _ in each.placements], device=device)
        viewer = like.new_tensor([each.camera.direction for each in scenes])[scene]
        sun = like.new_tensor([each.sun.direction for each in scenes])[scene]
        ground = like.new_tensor([[placement.x_m, placement.y_m, 0.0] for placement in placements])
        heading = like.new_tensor([placement.heading_rad for placement in placements])
        vertices = rotate_about_vertical(like, heading) + ground[:, None]

        screen, depth = project(vertices, viewer, camera.gsd_m, camera.size_px)
        shadow_screen, _ = project(vertices, sun, camera.gsd_m, camera.size_px)
        window, cast = windows_around(screen), windows_around(shadow_screen)
        sky = sky_shares(scenes, settings.sky_share, like)
        own_sky = None if sky is None else sky[scene]
        visibility, bodies = draw_bodies(window, screen, depth, vertices, viewer, sun, vehicles, settings, own_sky)
        shadows = draw_shadows(cast, shadow_screen, vehicles.template.faces, settings)
        nearness, seeds = (ground * viewer).sum(-1), [each.seed for each in scenes]
        image = composite(photographs, (window, bodies), (cast, shadows), scene, nearness, seeds, settings, sky)
        image = finish_images(image, scenes)

        visible_px, fraction, drawn = _label(visibility, window, settings.supersampling, camera.size_px, masks)
        boxes = torch.cat((screen.detach().amin(1), screen.detach().amax(1)), dim=1).clamp(0, camera.size_px)
        extent = torch.stack((vertices.detach().amin(1), vertices.detach().amax(1)))
        centres, _ = project(extent.mean(0)[:, None], viewer, camera.gsd_m, camera.size_px)
        return Frames(image, scene, boxes, centres[:, 0], visible_px.to(like), fraction.to(like), drawn)


@torch.no_grad()
def _label(
    visibility: Visibility, window: Windows, factor: int, size_px: int, masks: bool
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"], Bool[Tensor, "N H W"] | None]:
    """Visible pixels, the fraction inside the image, and the masks."""
    count = len(visibility.keys)
    vehicle = visibility.vehicle
    pixel = window.origin[vehicle] + torch.stack((visibility.x, visibility.y), dim=-1) // factor
    held = ((pixel >= 0) & (pixel < size_px)).all(-1)
    every = torch.bincount(vehicle, minlength=count).double()
    visible = torch.bincount(vehicle[held], minlength=count).double()
    drawn = None
    if masks:
        index = (vehicle * size_px + pixel[:, 1]) * size_px + pixel[:, 0]
        shares = torch.bincount(index[held], minlength=count * size_px * size_px)
        drawn = (shares * 2 >= factor**2).view(count, size_px, size_px)
    return visible / factor**2, visible / every.clamp(min=1), drawn
