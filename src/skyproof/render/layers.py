"""Samples to pixels: what each vehicle, and its shadow, puts on the pixels of its own window."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import vertex_normals
from skyproof.geometry.rasterise import Visibility, barycentric, rasterise
from skyproof.render.materials import CAMOUFLAGE, gloss_table
from skyproof.render.settings import RenderSettings
from skyproof.render.shade import Lighting, LinearTexture, light
from skyproof.render.silhouette import SilhouettePoints, silhouette_points
from skyproof.vehicles.vehicle import VehicleBatch

__all__ = ["Layers", "Windows", "draw_bodies", "draw_shadows", "windows_around"]

# Samples. A sample that happens to hit a sliver of width w has a derivative of order 1/w: right on
# average, but a single hit outweighs the whole body. Below this width the derivative is held at
# what this width would give.
_THINNEST = 0.1


@dataclass(frozen=True)
class Windows:
    """One square of whole pixels per vehicle, all of one size; they may reach beyond the image.

    Attributes:
        origin: `[N, 2]` top-left pixel (x, y).
        size: S, pixels.
    """

    origin: Int[Tensor, "N 2"]
    size: int

    def samples(self, screen: Float[Tensor, "N V 2"], factor: int) -> Float[Tensor, "N V 2"]:
        """Image pixels to samples of the window."""
        return (screen - self.origin[:, None].to(screen.dtype)) * factor


@dataclass(frozen=True)
class Layers:
    """What vehicles, or their shadows, put on the pixels of their windows.

    Attributes:
        window: where the pixels lie.
        values: `[N, C, S, S]` of bodies linear colour times coverage and coverage (4 channels), of
            shadows the parts of sun and sky that the ground loses (2 channels).
    """

    window: Windows
    values: Float[Tensor, "N C S S"]


@torch.no_grad()
def windows_around(screen: Float[Tensor, "N V 2"]) -> Windows:
    """Windows that hold every vehicle's points with a pixel to spare."""
    low = screen.amin(1).floor() - 1
    high = screen.amax(1).ceil() + 1
    return Windows(low.long(), int((high - low).max()))


def draw_bodies(
    window: Windows,
    screen: Float[Tensor, "N V 2"],
    depth: Float[Tensor, "N V"],
    vertices: Float[Tensor, "N V 3"],
    lighting: Lighting,
    vehicles: VehicleBatch,
    settings: RenderSettings,
) -> tuple[Visibility, Float[Tensor, "N 4 S S"]]:
    """Draws vehicles as the camera sees them, averaged from samples to pixels (section S2.2).

    Args:
        window: around every vehicle.
        screen: vertices in image pixels.
        depth: metres, smaller is nearer.
        vertices: metres, world frame.
        lighting: on each vehicle.
        vehicles: give template, texture and parts.
        settings: light and supersampling.

    Returns:
        What each sample sees, and per pixel linear colour times coverage (3) and coverage (1).
    """
    template, factor = vehicles.template, settings.supersampling
    # Visibility: which face each sample sees.
    wide = window.size * factor
    samples = window.samples(screen, factor)
    visibility = rasterise(samples.detach(), depth.detach(), template.faces, wide)
    # The texture, at the levels that are read.
    levels = _texture_levels(samples.detach(), vehicles).view(-1)
    seen = visibility.vehicle * len(template.faces) + visibility.face
    finest = int(levels.index_select(0, seen).min()) if len(seen) else 0
    texture = LinearTexture(vehicles.texture, finest, samples.dtype, vehicles.overlay)
    # The surface: one row per (vehicle, face) with all that is interpolated, so that a sample
    # takes one look-up.
    normals = vertex_normals(vertices, template.faces)[:, template.faces]
    uvs = template.uvs[template.face_uvs].to(normals.dtype).expand(len(normals), -1, -1, -1)
    surface = torch.cat((uvs, normals), dim=-1).flatten(0, 1).flatten(1)
    gloss = gloss_table(settings.gloss).to(normals)

    def radiance(vehicle: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        row = vehicle * len(template.faces) + face
        uv, normal = _interpolate(surface.index_select(0, row), weights).split((2, 3), dim=1)
        normal = torch.nn.functional.normalize(normal, dim=-1)
        albedo = texture.sample(uv, vehicle, levels.index_select(0, row))
        finish = gloss.index_select(0, _labels(vehicles, uv, vehicle))
        diffuse, mirrored = light(normal, lighting.of(vehicle), finish, settings)
        return torch.addcmul(mirrored, albedo, diffuse)

    # Light on the visible samples, averaged to pixels.
    centre = torch.stack((visibility.x, visibility.y), dim=-1) + 0.5
    corners = (
        samples[:, template.faces].flatten(0, 1).flatten(1).index_select(0, seen).view(-1, 3, 2)
    )
    colour = radiance(visibility.vehicle, visibility.face, _held_weights(corners, centre))
    layers = _average(visibility, colour, factor)
    # What moving silhouettes change; nothing in value.
    if samples.requires_grad:
        points = silhouette_points(samples, depth.detach(), template.faces, visibility)
        with torch.no_grad():
            edge_colour = radiance(points.vehicle, points.face, points.weights)
        layers = layers + _edges(visibility, points, colour.detach(), edge_colour, factor)
    return visibility, layers


def draw_shadows(
    window: Windows,
    screen: Float[Tensor, "N V 2"],
    faces: Int[Tensor, "F 3"],
    settings: RenderSettings,
) -> Float[Tensor, "N 1 S S"]:
    """Which part of each pixel's ground the sun does not reach: the vehicle as the sun sees it."""
    factor = settings.shadow_supersampling
    samples = window.samples(screen, factor)
    flat = samples.new_zeros(samples.shape[:2])
    seen = rasterise(samples.detach(), flat, faces, window.size * factor)
    white = samples.new_ones(len(seen.covered), 3)
    layers = _average(seen, white, factor)
    if samples.requires_grad:
        points = silhouette_points(samples, flat, faces, seen)
        layers = layers + _edges(seen, points, white, white.new_ones(len(points.face), 3), factor)
    return layers[:, 3:]


@torch.no_grad()
def _labels(
    vehicles: VehicleBatch, uv: Float[Tensor, "K 2"], vehicle: Int[Tensor, " K"]
) -> Int[Tensor, " K"]:
    """Returns the part at (u, v), or `CAMOUFLAGE` where a camouflage covers it."""
    if vehicles.repainted:
        return torch.full_like(vehicle, CAMOUFLAGE)
    height, width = vehicles.parts.shape[1:]
    column = (uv[:, 0] * width).long() % width
    row = (uv[:, 1] * height).long().clamp(0, height - 1)
    place = (vehicle * height + row) * width + column
    label = vehicles.parts.view(-1).index_select(0, place).long()
    if vehicles.overlay is None:
        return label
    covered = vehicles.overlay.mask.view(-1).index_select(0, place)
    return label.masked_fill(covered, CAMOUFLAGE)


@torch.no_grad()
def _texture_levels(samples: Float[Tensor, "N V 2"], vehicles: VehicleBatch) -> Int[Tensor, "N F"]:
    """Returns per triangle the pyramid level at which a texel is as long as a sample.

    The direction in which the texture is more squeezed counts.
    """
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


def _held_weights(
    corners: Float[Tensor, "K 3 2"], point: Float[Tensor, "K 2"]
) -> Float[Tensor, "K 3"]:
    """Returns the weights of three corners; their derivative is held where a triangle is thin."""
    weights = barycentric(corners, point)
    if not weights.requires_grad:
        return weights
    with torch.no_grad():
        a, b, c = corners.unbind(1)
        to_b, to_c = b - a, c - a
        area = to_c[:, 0] * to_b[:, 1] - to_c[:, 1] * to_b[:, 0]
        longest = torch.stack((to_b, to_c, c - b)).norm(dim=-1).amax(0)
        kept = (area / longest / _THINNEST).clamp(max=1.0)[:, None]
    return weights.detach().lerp(weights, kept)


def _interpolate(
    values: Float[Tensor, "K _"], weights: Float[Tensor, "K 3"]
) -> Float[Tensor, "K _"]:
    """Barycentric mean of three corners' values, which stand one after the other in a row."""
    first, second, third = values.chunk(3, dim=1)
    result = first * weights[:, :1]
    return torch.addcmul(torch.addcmul(result, second, weights[:, 1:2]), third, weights[:, 2:])


def _average(
    visibility: Visibility, colour: Float[Tensor, "K 3"], factor: int
) -> Float[Tensor, "N 4 S S"]:
    """Averages samples to pixels: colour times coverage, and coverage."""
    count, wide, _ = visibility.keys.shape
    size = wide // factor
    pixel = (visibility.vehicle * size + visibility.y // factor) * size + visibility.x // factor
    values = torch.cat((colour, colour.new_ones(len(colour), 1)), dim=1) / factor**2
    layers = colour.new_zeros(count * size * size, 4).index_add(0, pixel, values)
    return layers.view(count, size, size, 4).permute(0, 3, 1, 2)


def _edges(
    visibility: Visibility,
    points: SilhouettePoints,
    colour: Float[Tensor, "K 3"],
    edge_colour: Float[Tensor, "M 3"],
    factor: int,
) -> Float[Tensor, "N 4 S S"]:
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
    pixel = (points.vehicle * size + place[:, 1]) * size + place[:, 0]
    layers = step.new_zeros(count * size * size, 4)
    layers = layers.index_add(0, pixel, step * points.coverage[:, None] / factor**2)
    return layers.view(count, size, size, 4).permute(0, 3, 1, 2)
