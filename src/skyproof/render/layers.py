"""Averages samples to pixels: each vehicle, and each shadow, in a window of its own."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from skyproof.geometry.meshes import mesh_edges, vertex_normals
from skyproof.geometry.projection import project
from skyproof.geometry.rasterise import rasterise
from skyproof.kernels import launch, rows, struct
from skyproof.render.kernels.shadow import shadow_pixels, shadows_back
from skyproof.render.kernels.surface import Mesh, Paint, shade_pixels, texture_levels
from skyproof.render.kernels.surface_gradients import (
    shade_back_to_corners,
    shade_back_to_texels,
    silhouettes_back,
)
from skyproof.render.kernels.texture import LEVELS
from skyproof.render.lighting import SceneLights
from skyproof.render.linear_texture import LinearTexture
from skyproof.render.materials import gloss_table
from skyproof.render.placed import Placed, Windows
from skyproof.render.settings import RenderSettings
from skyproof.render.shadows import shade_rows
from skyproof.vehicles.vehicle import Template, VehicleBatch

# In metres. The sun's view has one depth per sample, though the surface there may be slanted.
# Points are therefore tested a little off the surface, and are lit a little behind that depth.
_OFF_SURFACE_M = 0.05


@dataclass(frozen=True)
class WindowLayers:
    """The drawn pixels of vehicles or shadows in their windows.

    Values of bodies are linear colour times coverage and coverage (4 channels), those of shadows
    the shares of sun and sky that the ground loses (2 channels).
    """

    window: Windows
    values: Float[Tensor, "N S S C"]


@lru_cache(maxsize=8)
def _topology(template: Template) -> tuple[Tensor, Tensor, list[Tensor]]:
    """A template's faces, texture coordinates of their corners, and edges with their two faces."""
    edges = [each.int() for each in mesh_edges(template.faces)]
    return template.faces.int(), template.uvs[template.face_uvs].float(), edges


@dataclass(frozen=True)
class SeenBodies:
    """The visible surface of bodies without texture, for camera and sun.

    `screen` and `sun_screen` are vertices in samples of the windows `window` and `cast`. They and
    the `normals` there are differentiable in the vehicles' vertices. `finest` is the finest
    pyramid level of a face. `mesh` holds all of it for kernels (`Mesh`).
    """

    placed: Placed
    window: Windows
    cast: Windows
    edges: list[Tensor]
    screen: Float[Tensor, "N V 2"]
    sun_screen: Float[Tensor, "N V 2"]
    normals: Float[Tensor, "N V 3"]
    finest: int
    mesh: Any

    @property
    def memory_bytes(self) -> int:
        """Returns about how many bytes of memory it takes."""
        return sum(each.capacity for each in vars(self.mesh).values() if isinstance(each, wp.array))


def see_bodies(
    placed: Placed, window: Windows, cast: Windows, vehicles: VehicleBatch, settings: RenderSettings
) -> SeenBodies:
    """Finds what camera and sun see of vehicles, in a window for each, without their textures."""
    faces = vehicles.template.faces
    own_faces, uvs, edges = _topology(vehicles.template)
    factor, sun_factor = settings.supersampling, settings.shadow_supersampling
    screen = window.samples(placed.screen, factor)
    sun_screen = cast.samples(placed.shadow_screen, sun_factor)
    normals = vertex_normals(placed.vertices, faces).contiguous()
    with torch.no_grad():
        off = torch.add(placed.vertices, normals, alpha=_OFF_SURFACE_M)
        places, depth = project(off, placed.sun, placed.gsd_m, placed.size_px)
        sun_places = torch.cat((cast.samples(places, sun_factor), depth[..., None]), dim=2)
    levels = torch.full((len(screen), len(faces)), LEVELS, dtype=torch.int32, device=faces.device)
    mesh = struct(
        Mesh,
        faces=own_faces,
        uvs=uvs,
        normals=normals.detach(),
        screen=screen.detach(),
        depth=placed.depth.detach(),
        keys=rasterise(screen, placed.depth, faces, window.size * factor),
        levels=levels,
        sun_screen=sun_screen.detach(),
        sun_keys=rasterise(sun_screen, placed.sun_depth, faces, cast.size * sun_factor),
        sun_places=sun_places,
        self_shadows=settings.self_shadows,
    )
    launch(texture_levels, levels.shape, mesh, float(vehicles.texture.shape[-1]), levels)
    finest = int(levels.min())
    return SeenBodies(placed, window, cast, edges, screen, sun_screen, normals, finest, mesh)


def draw_bodies(
    seen: SeenBodies, light: Float[Tensor, "N 20"], vehicles: VehicleBatch, settings: RenderSettings
) -> Float[Tensor, "N S S 4"]:
    """Draws the textures of seen vehicles, averaged from samples to pixels (section S2.2).

    It is differentiable in texture or overlay, and in the vertices, for a fixed set of samples plus
    moving silhouettes. The light is that of `lighting`.
    """
    over, own = vehicles.overlay, None
    if over is not None and vehicles.texture.dtype == torch.uint8:
        shown, own = over.texture[None], vehicles.texture
    else:
        shown = vehicles.worn_texture()
    masks = None if over is None else over.mask
    texture = LinearTexture(shown, seen.finest, own, None if own is None else masks)
    paint = struct(
        Paint,
        pyramid=texture.pyramid,
        parts=vehicles.parts,
        masks=masks,
        masked=masks is not None,
        repainted=vehicles.repainted,
        gloss=gloss_table(settings.gloss, shown.device),
        lights=light,
    )
    given = (shown, seen.screen, seen.normals)
    return _DrawnBodies.apply(*given, seen, texture, paint, settings.supersampling)


def draw_shadows(
    seen: SeenBodies, lights: SceneLights, settings: RenderSettings
) -> Float[Tensor, "N S S 2"]:
    """Draws the shares of sun and sky that seen vehicles take from the ground.

    It is differentiable in the shadow's silhouette and in the box of the contact shadow.
    """
    shades = shade_rows(seen.placed, seen.cast, lights)
    given = (seen.sun_screen, seen.placed.extent)
    return _DrawnShadows.apply(*given, seen, shades, settings.shadow_supersampling)


class _DrawnBodies(torch.autograd.Function):
    """Bodies on the pixels of their windows."""

    @staticmethod
    def forward(
        context: Any,
        shown: Tensor,
        screen: Float[Tensor, "N V 2"],
        normals: Float[Tensor, "N V 3"],
        seen: SeenBodies,
        texture: LinearTexture,
        paint: Any,
        factor: int,
    ) -> Float[Tensor, "N S S 4"]:
        layers = screen.new_empty(len(screen), seen.window.size, seen.window.size, 4)
        keep = context.needs_input_grad[0]
        reached = screen.new_empty(*seen.mesh.keys.shape if keep else (0, 0, 0), 3)
        rows(shade_pixels, layers.shape, seen.mesh, paint, factor, layers, keep, reached)
        context.kept = (seen, texture, paint, factor, reached, shown.shape)
        return layers

    @staticmethod
    @once_differentiable
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        seen, texture, paint, factor, reached, shape = context.kept
        mesh, gradient = seen.mesh, gradients[0].contiguous()
        to_shown = to_screen = to_normals = None
        if context.needs_input_grad[0]:
            to_texels = torch.zeros_like(texture.texels)
            given = (mesh, paint, factor, reached, gradient, to_texels)
            rows(shade_back_to_texels, gradient.shape, *given)
            to_shown = texture.back(to_texels, shape)
        if any(context.needs_input_grad[1:3]):
            to_screen, to_normals = torch.zeros_like(seen.screen), torch.zeros_like(seen.normals)
            given = (mesh, paint, factor, gradient, to_screen, to_normals)
            rows(shade_back_to_corners, gradient.shape, *given)
            given = (False, *seen.edges, factor, gradient, to_screen)
            dim = (len(gradient), len(seen.edges[0]))
            launch(silhouettes_back, dim, mesh, paint, mesh.screen, mesh.keys, *given)
        return to_shown, to_screen, to_normals, None, None, None, None


class _DrawnShadows(torch.autograd.Function):
    """Shadows on the pixels of their windows."""

    @staticmethod
    def forward(
        context: Any,
        screen: Float[Tensor, "N V 2"],
        extent: Float[Tensor, "N 2 3"],
        seen: SeenBodies,
        shades: Float[Tensor, "N 16"],
        factor: int,
    ) -> Float[Tensor, "N S S 2"]:
        cast = screen.new_empty(len(screen), seen.cast.size, seen.cast.size)
        layers = screen.new_empty(*cast.shape, 2)
        rows(shadow_pixels, cast.shape, seen.mesh.sun_keys, shades, factor, cast, layers)
        context.kept = (seen, shades, factor, cast)
        return layers

    @staticmethod
    @once_differentiable
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        seen, shades, factor, cast = context.kept
        mesh, gradient = seen.mesh, gradients[0].contiguous()
        to_cast, to_box = gradient.new_zeros(*cast.shape, 4), gradient.new_zeros(len(cast), 5)
        rows(shadows_back, cast.shape, shades, cast, gradient, to_cast, to_box)
        to_screen = torch.zeros_like(seen.sun_screen)
        given = (True, *seen.edges, factor, to_cast, to_screen)
        dim = (len(gradient), len(seen.edges[0]))
        launch(silhouettes_back, dim, mesh, Paint(), mesh.sun_screen, mesh.sun_keys, *given)
        to_extent = gradient.new_zeros(len(cast), 2, 3)
        to_extent[:, 0, :2], to_extent[:, 1] = to_box[:, :2], to_box[:, 2:]
        return to_screen, to_extent, None, None, None
