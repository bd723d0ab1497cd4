"""Vehicles and shadows laid over the photograph, in linear light, and what the sensor does to them (section S2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.layers import Windows
from skyproof.render.sensor import blur_matrix, sensor_noise
from skyproof.render.settings import RenderSettings

__all__ = ["composite"]


def composite(
    photographs: Float[Tensor, "B 3 H W"],
    bodies: tuple[Windows, Float[Tensor, "N 4 S S"]],
    shadows: tuple[Windows, Float[Tensor, "N 1 P P"]],
    scene: Int[Tensor, " N"],
    nearness: Float[Tensor, " N"],
    seeds: Sequence[int],
    settings: RenderSettings,
    shadow_light: Float[Tensor, "B 3"],
) -> Float[Tensor, "B 3 H W"]:
    """Lays blurred vehicles over the photographs, and adds noise where something was rendered.

    I = I_bg * (1 - (1 - shadow light) * G(shadow)) * (1 - G(coverage)) + G(coverage * colour), in linear light. A pixel
    that nothing reaches keeps the photograph's value exactly. A nearer vehicle hides a farther one; shadows fall on
    the ground alone.

    Differences from the paper: I_bg + G(I_fg - I_bg) (equation 1) is the same on even ground, but leaves I_bg - G(I_bg)
    standing on top of the vehicle: lane markings shine through. The photograph is already blurred; here it is hidden
    by as much as the blurred vehicle covers it.

    Args:
        photographs: sRGB; written over.
        bodies: per vehicle linear colour times coverage, and coverage.
        shadows: per vehicle the shaded part of each pixel.
        scene: each vehicle's image.
        nearness: orders the vehicles of an image; larger is nearer to the camera.
        seeds: of the noise, per image.
        settings: blur and noise.
        shadow_light: per image and channel, what is left of the light in a cast shadow.
    """
    count, _, height, width = photographs.shape
    origin, size = _whole([bodies[0], shadows[0]], scene, count, settings.blur_radius_px)
    rank = _ranks(scene, nearness)
    layers = _lay(
        bodies, origin, size, scene, rank, lambda below, above: below * (1 - above[:, 3:]) + above
    )
    shadow = _lay(
        shadows, origin, size, scene, rank, lambda below, above: below + above - below * above
    )

    steps = torch.arange(size, device=photographs.device)
    y, x = origin[:, 1, None] + steps, origin[:, 0, None] + steps
    channel = torch.arange(count * 3, device=photographs.device).view(count, 3, 1, 1) * (
        height * width
    )
    place = (
        (y.clamp(0, height - 1) * width)[:, None, :, None]
        + x.clamp(0, width - 1)[:, None, None, :]
        + channel
    )
    ground_srgb = photographs.view(-1)[place]
    ground = srgb_to_linear(ground_srgb)
    kernel = blur_matrix(size, settings.blur_sigma_px, settings.blur_radius_px, ground)
    layers, shadow = kernel @ layers @ kernel, kernel @ shadow @ kernel
    colour, alpha = layers[:, :3], layers[:, 3:]
    composed = ground * (1 - (1 - shadow_light[:, :, None, None]) * shadow) * (1 - alpha) + colour
    reached = (alpha.detach() > 0) | (shadow.detach() > 0)
    pixels = linear_to_srgb(composed)
    if settings.noise > 0:
        noise = sensor_noise(seeds, y, x, ground)
        pixels = torch.addcmul(pixels, alpha.detach(), noise, value=settings.noise)
    pixels = torch.where(reached, pixels.clamp(0.0, 1.0), ground_srgb)
    inside = ((y >= 0) & (y < height))[:, None, :, None] & ((x >= 0) & (x < width))[
        :, None, None, :
    ]
    place, pixels = place.reshape(-1), pixels.reshape(-1)
    if not bool(inside.all()):
        held = torch.nonzero(inside.expand(-1, 3, -1, -1).reshape(-1))[:, 0]
        place, pixels = place.index_select(0, held), pixels.index_select(0, held)
    # In place: a copy of the images would cost as much as the rest of this function.
    photographs.view(-1).index_put_((place,), pixels)
    return photographs


@torch.no_grad()
def _whole(
    windows: Sequence[Windows], scene: Tensor, count: int, margin_px: int
) -> tuple[Int[Tensor, "B 2"], int]:
    """Per image the top-left pixel of one window around all of its small ones and the blur; one common size."""
    index = scene[:, None].expand(-1, 2)
    far = torch.iinfo(torch.long).max // 4
    low = torch.full((count, 2), far, dtype=torch.long, device=scene.device)
    high = -low
    for window in windows:
        low = low.scatter_reduce(0, index, window.origin, "amin")
        high = high.scatter_reduce(0, index, window.origin + window.size, "amax")
    empty = low == far
    low, high = low.masked_fill(empty, 0) - margin_px, high.masked_fill(empty, 0) + margin_px
    return low, int((high - low).max())


@torch.no_grad()
def _ranks(scene: Int[Tensor, " N"], nearness: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """The place of each vehicle among those of its image, the farthest first."""
    order = torch.argsort(nearness, stable=True)
    order = order[torch.argsort(scene[order], stable=True)]
    sorted_scene = scene[order]
    first = torch.searchsorted(sorted_scene, sorted_scene)
    rank = torch.empty_like(scene)
    rank[order] = torch.arange(len(scene), device=scene.device) - first
    return rank


def _lay(
    drawn: tuple[Windows, Float[Tensor, "N C S S"]],
    origin: Int[Tensor, "B 2"],
    size: int,
    scene: Int[Tensor, " N"],
    rank: Int[Tensor, " N"],
    over: Callable[[Tensor, Tensor], Tensor],
) -> Float[Tensor, "B C W W"]:
    """Lays every vehicle's layers into its image's window, one vehicle per image at a time."""
    window, layers = drawn
    channels = layers.shape[1]
    shift = window.origin - origin[scene]
    steps = torch.arange(window.size, device=layers.device)
    rows, columns = shift[:, 1, None] + steps, shift[:, 0, None] + steps
    plane = (scene[:, None] * channels + torch.arange(channels, device=layers.device))[
        :, :, None, None
    ]
    place = (plane * size + rows[:, None, :, None]) * size + columns[:, None, None, :]
    canvas = layers.new_zeros(len(origin) * channels * size * size)
    for turn in range(int(rank.max()) + 1):
        chosen = rank == turn
        where, above = place[chosen], layers[chosen]
        laid = above if turn == 0 else over(canvas[where], above)
        canvas = canvas.index_put((where,), laid)
    return canvas.view(len(origin), channels, size, size)
