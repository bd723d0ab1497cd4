"""Samples to pixels: what each vehicle, and its shadow, puts on the pixels of its own window."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.meshes import at_corners, vertex_normals
from skyproof.geometry.rasterise import Visibility, barycentric, cross, rasterise
from skyproof.render.lighting import Lighting, light
from skyproof.render.linear_texture import LinearTexture
from skyproof.render.materials import CAMOUFLAGE, gloss_table
from skyproof.render.placed import Placed, Windows
from skyproof.render.settings import RenderSettings
from skyproof.render.shadows import SunView
from skyproof.render.silhouette import SilhouettePoints, silhouette_points
from skyproof.vehicles.vehicle import VehicleBatch

# Samples. A sample that happens to hit a sliver of width w has a derivative of order 1/w: right on
# average, but a single hit outweighs the whole body. Below this width the derivative is held at
# what this width would give.
_THINNEST = 0.1
# Farther away than any part of a vehicle.
_FAR_M = 1e6
# Keeps the direction of a vanishing normal finite.
_TINY = 1e-24


@dataclass(frozen=True)
class WindowLayers:
    """The drawn pixels of vehicles or shadows in their windows.

    Values of bodies are linear colour times coverage and coverage (4 channels), those of shadows
    the shares of sun and sky that the ground loses (2 channels).
    """

    window: Windows
    values: Float[Tensor, "N C S S"]


@dataclass(frozen=True)
class _Faces:
    """Values at the three corners of all faces of all bodies, and each face's texture level."""

    uvs: Float[Tensor, "3 2 M"]
    normals: Float[Tensor, "3 3 M"]
    levels: Int[Tensor, " M"]
    sun_places: Float[Tensor, "3 3 M"] | None
    sun: SunView | None

    def at(
        self, row: Int[Tensor, " K"], weights: Float[Tensor, "3 K"], vehicle: Int[Tensor, " K"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Texture coordinates, unit normals, texture levels and sunlight at points of faces.

        Sunlight is 1, or 0 behind a part of the vehicle; a single 1 without self-shadows.
        """
        uv, normal = _Interpolated.apply(self.uvs, self.normals, row, weights)
        normal = normal * (normal.square().sum(0) + _TINY).rsqrt()
        sunlit = weights.new_ones(1)
        if self.sun is not None and self.sun_places is not None:
            with torch.no_grad():
                corners = self.sun_places.flatten(0, 1).index_select(1, row).view(3, 3, -1)
                sunlit = self.sun.reaches((corners * weights[:, None]).sum(0), vehicle)
        return uv, normal, self.levels.index_select(0, row), sunlit


@dataclass(frozen=True)
class SeenBodies:
    """The visible surface of bodies without texture; differentiable in the vertices.

    Samples and faces are planes, one channel after the other, as in `at_corners`. `samples` are
    vertices in samples of the windows, and `surface` holds the values of `_Faces.at` per sample.
    """

    visibility: Visibility
    samples: Float[Tensor, "N V 2"]
    depth: Float[Tensor, "N V"]
    faces: _Faces
    surface: tuple[Tensor, Tensor, Tensor, Tensor]


def see_bodies(
    window: Windows,
    placed: Placed,
    vehicles: VehicleBatch,
    sun: SunView | None,
    settings: RenderSettings,
) -> SeenBodies:
    """Looks at vehicles as the camera does, without their textures."""
    template, factor = vehicles.template, settings.supersampling
    samples = window.samples(placed.screen, factor)
    wide = window.size * factor
    visibility = rasterise(samples.detach(), placed.depth.detach(), template.faces, wide)
    corners = at_corners(samples, template.faces)
    levels = _texture_levels(corners.detach(), vehicles)
    at_vertices = vertex_normals(placed.vertices, template.faces)
    normals = at_corners(at_vertices, template.faces)
    uvs = template.uvs[template.face_uvs].to(normals.dtype).permute(1, 2, 0)
    uvs = uvs.repeat(1, 1, len(placed.vertices))
    row = visibility.vehicle * len(template.faces) + visibility.face
    centre = torch.stack((visibility.x, visibility.y)) + 0.5
    weights = _held_weights(corners.flatten(0, 1).index_select(1, row).view(3, 2, -1), centre)
    sun_places = None if sun is None else sun.places(at_vertices, template.faces)
    faces = _Faces(uvs, normals, levels, sun_places, sun)
    surface = faces.at(row, weights, visibility.vehicle)
    if not samples.requires_grad:
        # Both are large, and buffers may be kept for long.
        faces = replace(faces, sun_places=None, sun=None)
    return SeenBodies(visibility, samples, placed.depth, faces, surface)


def draw_bodies(
    seen: SeenBodies, lighting: Lighting, vehicles: VehicleBatch, settings: RenderSettings
) -> Float[Tensor, "N 4 S S"]:
    """Draws the textures of seen vehicles, averaged from samples to pixels (section S2.2)."""
    visibility, factor = seen.visibility, settings.supersampling
    level = seen.surface[2]
    finest = int(level.min()) if len(level) else 0
    texture = LinearTexture(vehicles.texture, finest, seen.samples.dtype, vehicles.overlay)

    def radiance(
        vehicle: Tensor, uv: Tensor, normal: Tensor, level: Tensor, sunlit: Tensor
    ) -> Tensor:
        albedo = texture.sample(uv, vehicle, level)
        gloss = _gloss(vehicles, uv, vehicle, settings)
        diffuse, mirrored = light(normal, lighting, vehicle, sunlit, gloss, settings)
        return torch.addcmul(mirrored, albedo, diffuse)

    colour = radiance(visibility.vehicle, *seen.surface)
    layers = _average(visibility, colour, factor)
    # What moving silhouettes change; nothing in value.
    if seen.samples.requires_grad:
        faces = vehicles.template.faces
        points = silhouette_points(seen.samples, seen.depth.detach(), faces, visibility)
        with torch.no_grad():
            row = points.vehicle * len(faces) + points.face
            surface = seen.faces.at(row, points.weights, points.vehicle)
            edge_colour = radiance(points.vehicle, *surface)
        layers = layers + _edges(visibility, points, colour.detach(), edge_colour, factor)
    return layers


def draw_shadows(sun: SunView, faces: Int[Tensor, "F 3"]) -> Float[Tensor, "N 1 S S"]:
    """Which part of each pixel's ground the sun does not reach: the vehicle as the sun sees it."""
    seen, samples = sun.visibility, sun.samples
    # Samples without any colour leave coverage alone.
    nothing = samples.new_zeros(0, len(seen.covered))
    layers = _average(seen, nothing, sun.factor)
    if samples.requires_grad:
        # Only the ground behind it counts, not what of the vehicle lies behind an edge.
        before_ground = samples.new_full(samples.shape[:2], _FAR_M)
        points = silhouette_points(samples, before_ground, faces, seen)
        at_edges = samples.new_zeros(0, len(points.face))
        layers = layers + _edges(seen, points, nothing, at_edges, sun.factor)
    return layers


@torch.no_grad()
def _gloss(
    vehicles: VehicleBatch,
    uv: Float[Tensor, "2 K"],
    vehicle: Int[Tensor, " K"],
    settings: RenderSettings,
) -> Float[Tensor, "2 _"]:
    """Gloss of the part at (u, v) or its camouflage; one column if camouflage covers all."""
    table = gloss_table(settings.gloss).to(uv).t()
    if vehicles.repainted:
        return table[:, CAMOUFLAGE:]
    height, width = vehicles.parts.shape[1:]
    column = (uv[0] * width).long() % width
    row = (uv[1] * height).long().clamp(0, height - 1)
    place = (vehicle * height + row) * width + column
    label = vehicles.parts.view(-1).index_select(0, place).long()
    if vehicles.overlay is not None:
        covered = vehicles.overlay.mask.view(-1).index_select(0, place)
        label = label.masked_fill(covered, CAMOUFLAGE)
    return table.index_select(1, label)


@torch.no_grad()
def _texture_levels(corners: Float[Tensor, "3 2 M"], vehicles: VehicleBatch) -> Int[Tensor, " M"]:
    """Per triangle the pyramid level whose texel is as long as a sample, the squeezed way."""
    template = vehicles.template
    across, down = corners[1] - corners[0], corners[2] - corners[0]
    area = cross(across, down)
    texels = template.uvs[template.face_uvs] * vehicles.texture.shape[-1]
    texels = texels.permute(1, 2, 0).repeat(1, 1, len(vehicles))
    texel_across, texel_down = texels[1] - texels[0], texels[2] - texels[0]
    # The affine map from samples to texels, one column per image axis.
    per_x = (down[1] * texel_across - across[1] * texel_down) / area
    per_y = (across[0] * texel_down - down[0] * texel_across) / area
    longest = torch.maximum(per_x.square().sum(0), per_y.square().sum(0)).sqrt()
    return longest.clamp(1.0, 2.0**20).log2().round().nan_to_num(0.0).long()


def _held_weights(
    corners: Float[Tensor, "3 2 K"], point: Float[Tensor, "2 K"]
) -> Float[Tensor, "3 K"]:
    """Returns the weights of three corners; their derivative is held where a triangle is thin."""
    weights = barycentric(corners, point)
    if not weights.requires_grad:
        return weights
    with torch.no_grad():
        a, b, c = corners
        longest = torch.stack((b - a, c - a, c - b)).square().sum(1).amax(0).sqrt()
        kept = (cross(c - a, b - a) / longest / _THINNEST).clamp(max=1.0)
    return weights.detach().lerp(weights, kept)


class _Interpolated(torch.autograd.Function):
    """Barycentric means of texture coordinates and normals, with one look-up per sample."""

    @staticmethod
    def forward(
        context: Any, uvs: Tensor, normals: Tensor, row: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        surface = torch.cat((uvs, normals), dim=1)
        corners = surface.flatten(0, 1).index_select(1, row).view(3, surface.shape[1], -1)
        means = corners[0] * weights[0]
        for corner, weight in zip(corners[1:], weights[1:], strict=True):
            means.addcmul_(corner, weight)
        context.save_for_backward(corners, row, weights)
        context.columns = normals.shape[2]
        return means[:2], means[2:]

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        corners, row, weights = context.saved_tensors
        gradient = torch.cat(gradients)
        to_weights = torch.stack([(corner * gradient).sum(0) for corner in corners])
        to_normals = None
        if context.needs_input_grad[1]:
            spread = (weights[:, None] * gradients[1]).flatten(0, 1)
            to_normals = spread.new_zeros(9, context.columns).index_add_(1, row, spread)
            to_normals = to_normals.view(3, 3, -1)
        return None, to_normals, None, to_weights


def _average(
    visibility: Visibility, colour: Float[Tensor, "C K"], factor: int
) -> Float[Tensor, "N C+1 S S"]:
    """Averages samples to pixels: colour times coverage, and coverage."""
    count, wide, _ = visibility.keys.shape
    size = wide // factor
    x, y = visibility.cells(factor)
    pixel = (visibility.vehicle * size + y) * size + x
    return _summed(_with_coverage(colour), pixel, count, size) / factor**2


def _edges(
    visibility: Visibility,
    points: SilhouettePoints,
    colour: Float[Tensor, "C K"],
    edge_colour: Float[Tensor, "C M"],
    factor: int,
) -> Float[Tensor, "N C+1 S S"]:
    """Zero in value; carries the gradient of moving silhouettes into the averaged layers."""
    count, wide, _ = visibility.keys.shape
    size = wide // factor
    # The last column stands for an empty sample: no colour, no coverage.
    behind = torch.nn.functional.pad(_with_coverage(colour), (0, 1))
    behind = behind.index_select(1, visibility.find(points.outside))
    step = _with_coverage(edge_colour) - behind
    x, y = (points.place / factor).floor().long().clamp(0, size - 1)
    pixel = (points.vehicle * size + y) * size + x
    return _summed(step * (points.coverage / factor**2), pixel, count, size)


def _with_coverage(colour: Float[Tensor, "C K"]) -> Float[Tensor, "C+1 K"]:
    return torch.nn.functional.pad(colour, (0, 0, 0, 1), value=1.0)


def _summed(
    values: Float[Tensor, "C K"], pixel: Int[Tensor, " K"], count: int, size: int
) -> Float[Tensor, "N C S S"]:
    """Adds up what falls on each pixel of `count` windows."""
    layers = values.new_zeros(len(values), count * size * size).index_add(1, pixel, values)
    return layers.view(-1, count, size, size).transpose(0, 1)
