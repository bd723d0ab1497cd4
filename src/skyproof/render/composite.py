"""Vehicles and shadows laid over the photograph, in linear light, as the sensor shows them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.layers import Layers
from skyproof.render.sensor import blurred, sensor_noise
from skyproof.render.settings import RenderSettings

__all__ = ["composite"]


def composite(
    photographs: Float[Tensor, "B 3 H W"],
    *,
    bodies: Layers,
    shadows: Layers,
    scene: Int[Tensor, " N"],
    nearness: Float[Tensor, " N"],
    seeds: Sequence[int],
    shadow_light: Float[Tensor, "B 3"],
    settings: RenderSettings,
) -> Float[Tensor, "B 3 H W"]:
    """Lays blurred vehicles over the photographs, and adds noise where something was rendered.

    I = I_bg * (1 - (1 - shadow light) * G(shadow)) * (1 - G(coverage)) + G(coverage * colour), in
    linear light. A pixel that nothing reaches keeps the photograph's value exactly. A nearer
    vehicle hides a farther one; shadows fall on the ground alone.

    Differences from the paper: I_bg + G(I_fg - I_bg) (section 3.2) is the same on even ground, but
    leaves I_bg - G(I_bg) standing on top of the vehicle: lane markings shine through. The
    photograph is already blurred; here it is hidden by as much as the blurred vehicle covers it.

    Args:
        photographs: sRGB; written over.
        bodies: per vehicle linear colour times coverage (3), and coverage (1).
        shadows: per vehicle the shaded part of each pixel (1).
        scene: each vehicle's image.
        nearness: orders the vehicles of an image; larger is nearer to the camera.
        seeds: decide the noise, one per image.
        shadow_light: per image and channel, what remains of the light in a cast shadow.
        settings: blur and noise.
    """
    count, _, height, width = photographs.shape
    # One window per image, around all that is drawn into it and its blur.
    origin, size = _whole([bodies, shadows], scene, count, settings.blur_radius_px)
    rank = _ranks(scene, nearness)
    layers = _lay(bodies, origin, size, scene, rank, _cover)
    shadow = _lay(shadows, origin, size, scene, rank, _join)
    layers = blurred(layers, settings.blur_sigma_px, settings.blur_radius_px)
    shadow = blurred(shadow, settings.blur_sigma_px, settings.blur_radius_px)

    # Only the pixels that something reaches are worked on: `K` of them.
    steps = torch.arange(size, device=photographs.device)
    rows = origin[:, 1, None] + steps
    columns = origin[:, 0, None] + steps
    row_held = ((rows >= 0) & (rows < height))[:, :, None]
    column_held = ((columns >= 0) & (columns < width))[:, None, :]
    reached = (layers.detach()[:, 3] > 0) | (shadow.detach()[:, 0] > 0)
    cell = torch.nonzero((reached & row_held & column_held).view(-1))[:, 0]
    image = cell // (size * size)
    cell = cell - image * (size * size)
    y = origin[:, 1].index_select(0, image) + cell // size
    x = origin[:, 0].index_select(0, image) + cell % size
    place = _planes(image, 3, height * width) + (y * width + x)
    ground = srgb_to_linear(photographs.view(-1).index_select(0, place.view(-1)).view(3, -1))
    drawn = layers.reshape(-1).index_select(0, (_planes(image, 4, size * size) + cell).view(-1))
    colour, alpha = drawn.view(4, -1).split((3, 1))
    shade = shadow.reshape(-1).index_select(0, image * (size * size) + cell)

    # Light adds up; then the sensor makes a picture of it.
    kept_light = 1 - (1 - shadow_light.index_select(0, image).T) * shade
    pixels = linear_to_srgb(ground * kept_light * (1 - alpha) + colour)
    if settings.noise > 0:
        noise = sensor_noise(seeds, image, y, x, ground)
        pixels = torch.addcmul(pixels, alpha.detach(), noise, value=settings.noise)
    # In place: a copy of the images would cost as much as the rest of this function.
    photographs.view(-1).index_put_((place.view(-1),), pixels.clamp(0.0, 1.0).view(-1))
    return photographs


def _planes(image: Int[Tensor, " K"], channels: int, area: int) -> Int[Tensor, "C K"]:
    """Returns where each channel of an image begins in a flat batch of images."""
    channel = torch.arange(channels, device=image.device)[:, None]
    return (image * channels + channel) * area


@torch.no_grad()
def _whole(
    drawn: Sequence[Layers], scene: Int[Tensor, " N"], count: int, margin_px: int
) -> tuple[Int[Tensor, "B 2"], int]:
    """Returns per image the top-left pixel of one window around all small ones and the blur.

    All of these windows have one size, which is returned too.
    """
    index = scene[:, None].expand(-1, 2)
    far = torch.iinfo(torch.long).max // 4
    low = torch.full((count, 2), far, dtype=torch.long, device=scene.device)
    high = -low
    for layers in drawn:
        window = layers.window
        low = low.scatter_reduce(0, index, window.origin, "amin")
        high = high.scatter_reduce(0, index, window.origin + window.size, "amax")
    empty = low == far
    low = low.masked_fill(empty, 0) - margin_px
    high = high.masked_fill(empty, 0) + margin_px
    return low, int((high - low).max())


@torch.no_grad()
def _ranks(scene: Int[Tensor, " N"], nearness: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Returns the place of each vehicle among those of its image, the farthest first."""
    order = torch.argsort(nearness, stable=True)
    order = order[torch.argsort(scene[order], stable=True)]
    sorted_scene = scene[order]
    first = torch.searchsorted(sorted_scene, sorted_scene)
    rank = torch.empty_like(scene)
    rank[order] = torch.arange(len(scene), device=scene.device) - first
    return rank


def _cover(below: Tensor, above: Tensor) -> Tensor:
    """Lays a body over what is there."""
    return below * (1 - above[:, 3:]) + above


def _join(below: Tensor, above: Tensor) -> Tensor:
    """Joins two shadows, which darken the ground once."""
    return below + above - below * above


def _lay(
    drawn: Layers,
    origin: Int[Tensor, "B 2"],
    size: int,
    scene: Int[Tensor, " N"],
    rank: Int[Tensor, " N"],
    over: Callable[[Tensor, Tensor], Tensor],
) -> Float[Tensor, "B C W W"]:
    """Lays every vehicle's layers into its image's window, one vehicle per image at a time."""
    window, layers = drawn.window, drawn.values
    channels = layers.shape[1]
    # Where each pixel of each vehicle's window lies on the canvas of all windows.
    shift = window.origin - origin[scene]
    steps = torch.arange(window.size, device=layers.device)
    rows = (shift[:, 1, None] + steps)[:, None, :, None]
    columns = (shift[:, 0, None] + steps)[:, None, None, :]
    channel = torch.arange(channels, device=layers.device)
    plane = (scene[:, None] * channels + channel)[:, :, None, None]
    place = (plane * size + rows) * size + columns
    canvas = layers.new_zeros(len(origin) * channels * size * size)
    for turn in range(int(rank.max()) + 1):
        chosen = rank == turn
        where = place[chosen]
        above = layers[chosen]
        laid = above if turn == 0 else over(canvas[where], above)
        canvas.index_put_((where,), laid)
    return canvas.view(len(origin), channels, size, size)
