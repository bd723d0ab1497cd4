"""The differentiable renderer: vehicles onto orthophotos, in plain PyTorch (PAPER 10-14)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.geometry.meshes import vertex_normals
from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.render.frames import Frames
from skyproof.render.rasterise import Visibility, rasterise
from skyproof.render.settings import RenderSettings
from skyproof.render.shade import LinearTexture, light
from skyproof.render.silhouette import SilhouettePoints, silhouette_points
from skyproof.scenes.scene import BackgroundWindow, Scene
from skyproof.vehicles.vehicle import Template, VehicleBatch

__all__ = ["Backgrounds", "TorchRenderer"]

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 128


class Backgrounds(Protocol):
    """Where the renderer takes its photographs from."""

    def window(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "3 H W"]:
        """A square window, sRGB in [0, 1]."""
        ...


@dataclass(frozen=True)
class _Placed:
    """All vehicles of a batch, put into the world; one row per placement."""

    vertices: Float[Tensor, "N V 3"]
    scene: Int[Tensor, " N"]
    viewer: Float[Tensor, "N 3"]
    sun: Float[Tensor, "N 3"]


class TorchRenderer:
    """Draws vehicles onto photographs, differentiably in their texture and their vertices.

    Only a window around each image's vehicles and shadows is rendered, at `supersampling` samples a pixel side, shaded
    by sun and sky, averaged, laid over the photograph in linear light, and blurred as
    I = I_bg + G(I_fg - I_bg) (PAPER 11, 12).

    Differences from the paper: the camera is the orthophoto's own parallel projection (see `Camera`), not a
    perspective one at a distance that the paper does not give; there is a cast shadow; light adds up linearly; noise
    is added where something was rendered.

    Vertex gradients hold for a fixed set of visible triangles plus moving silhouettes, of the body and of its shadow.
    Vehicles cast no shadow on themselves or on each other.
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
        photographs = self.photographs(scenes, device)
        if not placements:
            nothing = photographs.new_zeros(0)
            empty_masks = photographs.new_zeros(0, *photographs.shape[2:]).bool() if masks else None
            return Frames(
                photographs,
                torch.zeros(0, dtype=torch.long, device=device),
                nothing.view(0, 4),
                nothing.view(0, 2),
                nothing,
                nothing,
                empty_masks,
            )
        camera = scenes[0].camera
        placed = _place(scenes, vehicles)
        screen, depth = project(placed.vertices, placed.viewer, camera.gsd_m, camera.size_px)
        shadow_screen, _ = project(placed.vertices, placed.sun, camera.gsd_m, camera.size_px)
        body = _windows(screen, placed.scene, len(scenes), margin_px=1)
        cast = _windows(shadow_screen, placed.scene, len(scenes), margin_px=1)
        whole = _windows(
            torch.cat((screen, shadow_screen), dim=1), placed.scene, len(scenes), self.settings.blur_radius_px + 1
        )

        visibility, layers = self._draw_body(body, screen, depth, placed, vehicles)
        shadow = self._draw_shadow(cast, shadow_screen, vehicles.template.faces, placed.scene)
        image = self._composite(photographs, whole, _inset(layers, body, whole), _inset(shadow, cast, whole), scenes)
        labels = _label(visibility, placed.scene, body, self.settings.supersampling, camera.size_px, screen, masks)
        extent = torch.stack((placed.vertices.detach().amin(1), placed.vertices.detach().amax(1)))
        centres, _ = project(extent.mean(0)[:, None], placed.viewer, camera.gsd_m, camera.size_px)
        return Frames(image, placed.scene, labels.boxes, centres[:, 0], labels.visible, labels.fraction, labels.masks)

    def _draw_body(
        self,
        window: _Windows,
        screen: Float[Tensor, "N V 2"],
        depth: Float[Tensor, "N V"],
        placed: _Placed,
        vehicles: VehicleBatch,
    ) -> tuple[Visibility, Float[Tensor, "B 4 S S"]]:
        """Visibility first, then light on the visible samples, then averaging to pixels (PAPER 11)."""
        template, factor = vehicles.template, self.settings.supersampling
        wide = window.size * factor
        samples = window.samples(screen, placed.scene, factor)
        visibility = rasterise(samples.detach(), depth.detach(), template.faces, placed.scene, len(window.origin), wide)
        row = visibility.covered % (wide * wide)
        centre = torch.stack((row % wide, row // wide), dim=-1) + 0.5
        corners = samples[visibility.vehicle[:, None], template.faces[visibility.face]]
        levels = _texture_levels(samples.detach(), vehicles)
        finest = int(levels[visibility.vehicle, visibility.face].min()) if len(visibility.face) else 0
        texture = LinearTexture(vehicles.texture, finest, samples.dtype)
        surface = self._surface(texture, levels, placed, template)
        colour = surface(visibility.vehicle, visibility.face, _barycentric(corners, centre))
        layers = _average(visibility, colour, factor, window.size)
        if samples.requires_grad:
            points = silhouette_points(samples, depth.detach(), template.faces, placed.scene, visibility)
            with torch.no_grad():
                edge_colour = surface(points.vehicle, points.face, points.weights)
            layers = layers + _edges(visibility, points, colour.detach(), edge_colour, factor)
        return visibility, layers

    def _surface(
        self, texture: LinearTexture, levels: Int[Tensor, "N F"], placed: _Placed, template: Template
    ) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        """Linear radiance as a function of (vehicle `[K]`, face `[K]`, barycentric weights `[K, 3]`)."""
        normals = vertex_normals(placed.vertices, template.faces)

        def radiance(vehicle: Tensor, face: Tensor, weights: Tensor) -> Tensor:
            uv = _interpolate(template.uvs[template.face_uvs[face]], weights)
            normal = _interpolate(normals[vehicle[:, None], template.faces[face]], weights)
            normal = torch.nn.functional.normalize(normal, dim=-1)
            albedo = texture.sample(uv, vehicle, levels[vehicle, face])
            diffuse, mirrored = light(normal, placed.sun[vehicle], placed.viewer[vehicle], self.settings)
            return albedo * diffuse + mirrored

        return radiance

    def _draw_shadow(
        self,
        window: _Windows,
        screen: Float[Tensor, "N V 2"],
        faces: Int[Tensor, "F 3"],
        scene: Int[Tensor, " N"],
    ) -> Float[Tensor, "B 1 S S"]:
        """Which part of each pixel's ground the sun does not reach: the vehicle as the sun sees it."""
        factor = self.settings.shadow_supersampling
        samples = window.samples(screen, scene, factor)
        flat = samples.new_zeros(samples.shape[:2])
        seen = rasterise(samples.detach(), flat, faces, scene, len(window.origin), window.size * factor)
        white = samples.new_ones(len(seen.covered), 3)
        layers = _average(seen, white, factor, window.size)
        if samples.requires_grad:
            points = silhouette_points(samples, flat, faces, scene, seen)
            layers = layers + _edges(seen, points, white, white.new_ones(len(points.face), 3), factor)
        return layers[:, 3:]

    def _composite(
        self,
        photographs: Float[Tensor, "B 3 H W"],
        window: _Windows,
        layers: Float[Tensor, "B 4 S S"],
        shadow: Float[Tensor, "B 1 S S"],
        scenes: Sequence[Scene],
    ) -> Float[Tensor, "B 3 H W"]:
        """Lays the vehicles over the photographs, blurs the difference, adds noise where something was rendered."""
        settings, size = self.settings, window.size
        count, _, height, width = photographs.shape
        steps = torch.arange(size, device=photographs.device)
        y, x = window.origin[:, 1, None] + steps, window.origin[:, 0, None] + steps
        inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None, :]
        channel = torch.arange(count * 3, device=photographs.device).view(count, 3, 1, 1) * (height * width)
        place = (y.clamp(0, height - 1) * width)[:, None, :, None] + x.clamp(0, width - 1)[:, None, None, :] + channel
        ground_srgb = photographs.view(-1)[place]
        ground = srgb_to_linear(ground_srgb)
        colour, alpha = layers[:, :3], layers[:, 3:]
        composed = ground * (1 - (1 - settings.sky_share) * shadow) * (1 - alpha) + colour
        kernel = _blur_matrix(size, settings.blur_sigma_px, settings.blur_radius_px, ground)
        difference = kernel @ (composed - ground) @ kernel
        # Written as a change, so that an untouched pixel keeps the photograph's exact value.
        change = linear_to_srgb(ground + difference) - linear_to_srgb(ground)
        if settings.noise > 0:
            noise = _noise(scenes, y % _NOISE_TILE_PX, x % _NOISE_TILE_PX, ground)
            change = change + settings.noise * (kernel @ alpha.detach() @ kernel) * noise
        pixels = (ground_srgb + change).clamp(0.0, 1.0)
        inside = inside[:, None].expand(-1, 3, -1, -1)
        return photographs.view(-1).index_put((place[inside],), pixels[inside]).view_as(photographs)


@dataclass(frozen=True)
class _Windows:
    """One square of whole pixels per image, all of one size, that may reach beyond the image."""

    origin: Int[Tensor, "B 2"]
    size: int

    def samples(self, screen: Float[Tensor, "N V 2"], scene: Int[Tensor, " N"], factor: int) -> Float[Tensor, "N V 2"]:
        """Image pixels to samples of the window."""
        return (screen - self.origin[scene][:, None].to(screen.dtype)) * factor


@torch.no_grad()
def _windows(points: Float[Tensor, "N P 2"], scene: Int[Tensor, " N"], count: int, margin_px: int) -> _Windows:
    index = scene[:, None].expand(-1, 2)
    low = points.new_full((count, 2), torch.inf).scatter_reduce(0, index, points.amin(1), "amin")
    high = points.new_full((count, 2), -torch.inf).scatter_reduce(0, index, points.amax(1), "amax")
    filled = torch.isfinite(low)
    low = torch.where(filled, low, 0.0).floor() - margin_px
    high = torch.where(filled, high, 0.0).ceil() + margin_px
    return _Windows(low.long(), int((high - low).max()))


def _inset(layers: Float[Tensor, "B C S S"], window: _Windows, whole: _Windows) -> Float[Tensor, "B C W W"]:
    """Puts every image's small window into its larger one, with zeros around it."""
    count, channels, size, _ = layers.shape
    shift = window.origin - whole.origin
    steps = torch.arange(size, device=layers.device)
    rows = (shift[:, 1, None] + steps)[:, None, :, None]
    columns = (shift[:, 0, None] + steps)[:, None, None, :]
    plane = torch.arange(count * channels, device=layers.device).view(count, channels, 1, 1)
    place = (plane * whole.size + rows) * whole.size + columns
    # The larger window may be smaller than this one's common size: what sticks out is empty.
    held = ((rows >= 0) & (rows < whole.size) & (columns >= 0) & (columns < whole.size)).expand_as(layers)
    flat = layers.new_zeros(count * channels * whole.size * whole.size)
    return flat.index_put((place[held],), layers[held]).view(count, channels, whole.size, whole.size)


def _place(scenes: Sequence[Scene], vehicles: VehicleBatch) -> _Placed:
    like = vehicles.vertices
    placements = [placement for scene in scenes for placement in scene.placements]
    heading = like.new_tensor([placement.heading_rad for placement in placements])
    offset = like.new_tensor([[placement.x_m, placement.y_m, 0.0] for placement in placements])
    counts = torch.tensor([len(scene.placements) for scene in scenes], device=like.device)
    scene_index = torch.repeat_interleave(torch.arange(len(scenes), device=like.device), counts)
    viewer = like.new_tensor([scene.camera.direction for scene in scenes])
    sun = like.new_tensor([scene.sun.direction for scene in scenes])
    vertices = rotate_about_vertical(like, heading) + offset[:, None]
    return _Placed(vertices, scene_index, viewer[scene_index], sun[scene_index])


@torch.no_grad()
def _texture_levels(samples: Float[Tensor, "N V 2"], vehicles: VehicleBatch) -> Int[Tensor, "N F"]:
    """Per triangle the pyramid level at which a texel is as long as a sample, along its more squeezed direction."""
    template = vehicles.template
    corners = samples[:, template.faces]
    across, down = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    area = (across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])[..., None]
    texels = template.uvs[template.face_uvs] * vehicles.texture.shape[-1]
    texel_across, texel_down = texels[:, 1] - texels[:, 0], texels[:, 2] - texels[:, 0]
    # The affine map from samples to texels, one column per image axis.
    per_x = (down[..., 1:] * texel_across - across[..., 1:] * texel_down) / area
    per_y = (across[..., :1] * texel_down - down[..., :1] * texel_across) / area
    longest = torch.maximum(per_x.square().sum(-1), per_y.square().sum(-1)).sqrt()
    return longest.clamp(1.0, 2.0**20).log2().round().nan_to_num(0.0).long()


def _barycentric(corners: Float[Tensor, "K 3 2"], point: Float[Tensor, "K 2"]) -> Float[Tensor, "K 3"]:
    """Weights of the three corners at `point`, differentiable in the corners."""
    a, b, c = corners.unbind(1)
    to_b, to_c, to_point = b - a, c - a, point - a
    area = to_c[:, 0] * to_b[:, 1] - to_c[:, 1] * to_b[:, 0]
    second = (to_c[:, 0] * to_point[:, 1] - to_c[:, 1] * to_point[:, 0]) / area
    third = (to_point[:, 0] * to_b[:, 1] - to_point[:, 1] * to_b[:, 0]) / area
    return torch.stack((1 - second - third, second, third), dim=-1)


def _interpolate(values: Float[Tensor, "K 3 C"], weights: Float[Tensor, "K 3"]) -> Float[Tensor, "K C"]:
    first, second, third = weights[..., None].unbind(1)
    return values[:, 0] * first + values[:, 1] * second + values[:, 2] * third


def _average(visibility: Visibility, colour: Float[Tensor, "K 3"], factor: int, size: int) -> Float[Tensor, "B 4 S S"]:
    """Averages samples to pixels: colour times coverage, and coverage."""
    count, wide, _ = visibility.keys.shape
    row = visibility.covered // wide
    x = visibility.covered - row * wide
    # Windows are stacked, so a row of samples maps to a row of pixels across all of them.
    pixel = row // factor * size + x // factor
    values = torch.cat((colour, colour.new_ones(len(colour), 1)), dim=1) / factor**2
    layers = colour.new_zeros(count * size * size, 4).index_add(0, pixel, values)
    return layers.view(count, size, size, 4).permute(0, 3, 1, 2)


def _edges(
    visibility: Visibility,
    points: SilhouettePoints,
    colour: Float[Tensor, "K 3"],
    edge_colour: Float[Tensor, "M 3"],
    factor: int,
) -> Float[Tensor, "B 4 S S"]:
    """Zero in value; carries the gradient of moving silhouettes into the averaged layers."""
    count, wide, _ = visibility.keys.shape
    size = wide // factor
    # The last row stands for an empty sample: no colour, no coverage.
    slot = torch.full((count * wide * wide,), -1, dtype=torch.long, device=colour.device)
    slot[visibility.covered] = torch.arange(len(colour), device=colour.device)
    behind = torch.cat((colour, colour.new_ones(len(colour), 1)), dim=1)
    behind = torch.cat((behind, behind.new_zeros(1, 4)))[slot[points.outside]]
    step = torch.cat((edge_colour, edge_colour.new_ones(len(edge_colour), 1)), dim=1) - behind
    place = (points.place / factor).floor().long().clamp(0, size - 1)
    pixel = (points.window * size + place[:, 1]) * size + place[:, 0]
    layers = step.new_zeros(count * size * size, 4)
    layers = layers.index_add(0, pixel, step * points.coverage[:, None] / factor**2)
    return layers.view(count, size, size, 4).permute(0, 3, 1, 2)


def _blur_matrix(size: int, sigma_px: float, radius_px: int, like: Tensor) -> Float[Tensor, "S S"]:
    """The Gaussian blur of a row of pixels as a banded matrix, zero beyond the ends (PAPER 12)."""
    steps = torch.arange(size, device=like.device)
    distance = (steps[:, None] - steps).abs()
    if radius_px == 0:
        return torch.eye(size, dtype=like.dtype, device=like.device)
    weights = torch.exp(-0.5 * (torch.arange(-radius_px, radius_px + 1, dtype=torch.float64) / sigma_px) ** 2).sum()
    kernel = torch.exp(-0.5 * (distance.to(like.dtype) / sigma_px) ** 2) / float(weights)
    return kernel * (distance <= radius_px)


def _noise(
    scenes: Sequence[Scene], y: Int[Tensor, "B S"], x: Int[Tensor, "B S"], like: Float[Tensor, "B 3 S S"]
) -> Float[Tensor, "B 3 S S"]:
    """Unit noise from every scene's own seed, tied to image pixels: the same whatever else is in the batch."""
    shape = (3, _NOISE_TILE_PX, _NOISE_TILE_PX)
    drawn = [torch.randn(shape, generator=torch.Generator().manual_seed(scene.seed)) for scene in scenes]
    tile = torch.stack(drawn).to(like)
    image = torch.arange(len(scenes), device=like.device)
    return tile.permute(0, 2, 3, 1)[image[:, None, None], y[:, :, None], x[:, None, :]].permute(0, 3, 1, 2)


@dataclass(frozen=True)
class _Labels:
    boxes: Float[Tensor, "N 4"]
    visible: Float[Tensor, " N"]
    fraction: Float[Tensor, " N"]
    masks: Bool[Tensor, "N H W"] | None


@torch.no_grad()
def _label(
    visibility: Visibility,
    scene: Int[Tensor, " N"],
    window: _Windows,
    factor: int,
    size_px: int,
    screen: Float[Tensor, "N V 2"],
    masks: bool,
) -> _Labels:
    count, wide = len(scene), visibility.keys.shape[-1]
    vehicle, row = visibility.vehicle, visibility.covered % (wide * wide)
    pixel = window.origin[scene[vehicle]] + torch.stack((row % wide, row // wide), dim=-1) // factor
    held = ((pixel >= 0) & (pixel < size_px)).all(-1)
    every = torch.bincount(vehicle, minlength=count).to(screen.dtype)
    visible = torch.bincount(vehicle[held], minlength=count).to(screen.dtype)
    boxes = torch.cat((screen.amin(1), screen.amax(1)), dim=1).clamp(0, size_px)
    chosen = None
    if masks:
        index = (vehicle * size_px + pixel[:, 1]) * size_px + pixel[:, 0]
        shares = torch.bincount(index[held], minlength=count * size_px * size_px)
        chosen = (shares * 2 >= factor**2).view(count, size_px, size_px)
    return _Labels(boxes, visible / factor**2, visible / every.clamp(min=1), chosen)
