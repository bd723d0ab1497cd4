"""Vehicles and shadows laid over the photograph, in linear light, as the sensor shows them.

Crowns and roofs of the photograph hide parts of the vehicles that stand beneath.
"""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.geometry.rasterise import rasterise
from skyproof.render.layers import WindowLayers
from skyproof.render.lighting import SceneLights
from skyproof.render.placed import Placed, windows_around
from skyproof.render.sensor import blurred, sensor_noise
from skyproof.scenes.scene import BackgroundWindow, Scene
from skyproof.scenes.sensor import Sensor

# Pixels around a vehicle and its shadow that the sensor's blur reaches.
_BLUR_PX = 2


def composite(
    photographs: Float[Tensor, "B 3 H W"],
    *,
    bodies: WindowLayers,
    shadows: WindowLayers,
    scene: Int[Tensor, " N"],
    nearness: Float[Tensor, " N"],
    seeds: Sequence[int],
    lights: SceneLights,
    sensors: Sequence[Sensor],
    cover: Float[Tensor, "B 1 H W"] | None = None,
) -> Float[Tensor, "B 3 H W"]:
    """Lays blurred vehicles over the photographs, and adds noise where something was rendered.

    I = I_bg * kept * (1 - G(coverage)) + G(coverage * colour), in linear light, where kept is the
    sun and sky that the blurred shadows leave. The photograph's light decides its black, white and
    shoulder. A pixel out of reach keeps the photograph's value exactly. A nearer vehicle hides a
    farther one. Shadows fall on the ground alone.

    Differences from the paper: I_bg + G(I_fg - I_bg) (section 3.2) is the same on even ground, but
    lane markings shine through the vehicle. Here the photograph is hidden by as much as the blurred
    vehicle covers it.

    Args:
        photographs: sRGB; written over.
        nearness: orders the vehicles of an image; larger is nearer to the camera.
        seeds: seeds of the noise, one per image.
        cover: share of each pixel in which the photograph hides all of this.
    """
    count, _, height, width = photographs.shape
    # One window per image, around all that is drawn near it; another of it and its blur, of which
    # only what lies inside the photograph is worked out.
    margin_px = max(sensor.blur_radius_px for sensor in sensors)
    origin, size = _whole([bodies, shadows], scene, count, (width, height), margin_px + 1)
    shown, shape = _inside(origin, size, margin_px, (width, height))
    rank = _ranks(scene, nearness)
    layers = _lay(bodies, origin, size, scene, rank, _cover)
    shadow = _lay(shadows, origin, size, scene, rank, _join)
    drawn = blurred(torch.cat((layers, shadow), dim=1), sensors, shown - origin, shape)
    colour, alpha, sun_lost, sky_lost = drawn.split((3, 1, 1, 1), dim=1)

    x = shown[:, 0, None] + torch.arange(shape[0], device=photographs.device)
    y = shown[:, 1, None] + torch.arange(shape[1], device=photographs.device)
    pixel = (y * width)[:, None, :, None] + x[:, None, None, :]
    place = (pixel + _planes(count, 3, height * width, photographs.device)).flatten()
    ground_srgb = photographs.view(-1).index_select(0, place).view(count, 3, *shape[::-1])

    # Light adds up; then the sensor makes a picture of it.
    ground = lights.received(srgb_to_linear(ground_srgb))
    sky = lights.sky[:, :, None, None]
    kept_light = 1 - (1 - sky) * sun_lost - sky * sky_lost
    pixels = linear_to_srgb(lights.shown(ground * kept_light * (1 - alpha) + colour))
    if any(sensor.noise > 0 for sensor in sensors):
        noise = sensor_noise(seeds, y, x, ground)
        strength = ground.new_tensor([sensor.noise for sensor in sensors])[:, None, None, None]
        pixels = torch.addcmul(pixels, strength * alpha.detach(), noise)
    reached = (drawn.detach()[:, 3:] > 0).any(1, keepdim=True)
    pixels = torch.where(reached, pixels.clamp(0.0, 1.0), ground_srgb)
    if cover is not None:
        covering = pixel + _planes(count, 1, height * width, photographs.device)
        pixels = hidden(pixels, ground_srgb, cover.view(-1)[covering])
    # In place: a copy of the images would cost as much as the rest of this function.
    photographs.view(-1).index_put_((place,), pixels.flatten())
    return photographs


@torch.no_grad()
def _inside(
    origin: Int[Tensor, "B 2"], size: int, margin_px: int, whole: tuple[int, int]
) -> tuple[Int[Tensor, "B 2"], tuple[int, int]]:
    """Windows (x, y) inside the images around the given ones and a margin, and their one size."""
    wide = min(size + 2 * margin_px, whole[0])
    high = min(size + 2 * margin_px, whole[1])
    most = origin.new_tensor([whole[0] - wide, whole[1] - high])
    return (origin - margin_px).clamp(min=0).minimum(most), (wide, high)


def _planes(count: int, channels: int, area: int, device: torch.device) -> Int[Tensor, "B C 1 1"]:
    """Returns where each channel of each image begins in a flat batch of images."""
    return (torch.arange(count * channels, device=device) * area).view(count, channels, 1, 1)


@torch.no_grad()
def _whole(
    drawn: Sequence[WindowLayers],
    scene: Int[Tensor, " N"],
    count: int,
    whole: tuple[int, int],
    margin_px: int,
) -> tuple[Int[Tensor, "B 2"], int]:
    """Per image the top-left pixel of one window around all small ones, and their one size.

    They reach beyond an image by no more than a margin; `_lay` gathers what is farther out.
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
    most = low.new_tensor(whole) + margin_px
    low = low.masked_fill(empty, 0).clamp(min=-margin_px).minimum(most)
    high = high.masked_fill(empty, 0).clamp(min=-margin_px).minimum(most)
    return low, max(1, int((high - low).max()))


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
    drawn: WindowLayers,
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
    rows = (shift[:, 1, None] + steps).clamp(0, size - 1)[:, None, :, None]
    columns = (shift[:, 0, None] + steps).clamp(0, size - 1)[:, None, None, :]
    channel = torch.arange(channels, device=layers.device)
    plane = (scene[:, None] * channels + channel)[:, :, None, None]
    place = (plane * size + rows) * size + columns
    canvas = layers.new_zeros(len(origin) * channels * size * size)
    for turn in range(int(rank.max()) + 1):
        chosen = torch.nonzero(rank == turn)[:, 0]
        where = place.index_select(0, chosen)
        above = layers.index_select(0, chosen)
        if turn:
            below = canvas.index_select(0, where.flatten()).view_as(above)
            above = over(below, above)
        canvas.index_put_((where,), above)
    return canvas.view(len(origin), channels, size, size)


@torch.no_grad()
def covers(
    cover_of: Callable[[BackgroundWindow, int], Tensor | None],
    scenes: Sequence[Scene],
    placed: Placed,
    faces: Int[Tensor, "F 3"],
) -> Float[Tensor, "B 1 H W"] | None:
    """Returns the share of each pixel in which the photograph hides the vehicles; None for none.

    It is 0 around a vehicle on top of the cover (`Placement.covered` is 0 there) and its shadow.
    Cover is flat: it does not lean with the camera.
    """
    size_px = placed.size_px
    found: Float[Tensor, "B 1 H W"] | None = None
    for index, scene in enumerate(scenes):
        if not any(placement.covered for placement in scene.placements):
            continue
        cover = cover_of(scene.background, size_px)
        if cover is None:
            continue
        if found is None:
            found = placed.vertices.new_zeros(len(scenes), 1, size_px, size_px)
        found[index, 0] = cover.to(found)
    if found is None:
        return None
    # Vehicles on top, in the scenes in which others stand beneath.
    covered = torch.tensor(
        [placement.covered for scene in scenes for placement in scene.placements],
        device=found.device,
    )
    some = found.flatten(1).any(1)
    rows = torch.nonzero((covered == 0) & some[placed.scene])[:, 0]
    if len(rows):
        found = found.masked_fill(_drawn(placed, rows, faces, len(scenes)), 0.0)
    return found


def hidden(
    image: Float[Tensor, "B 3 H W"],
    photographs: Float[Tensor, "B 3 H W"],
    cover: Float[Tensor, "B 1 H W"],
) -> Float[Tensor, "B 3 H W"]:
    """Lays what covers the vehicles over them again; other pixels keep their bits."""
    return torch.where(cover > 0, torch.lerp(image, photographs, cover), image)


def _drawn(
    placed: Placed, rows: Int[Tensor, " K"], faces: Int[Tensor, "F 3"], count: int
) -> Bool[Tensor, "B 1 H W"]:
    """Returns the pixels of some vehicles and their shadows, and what the blur makes of them."""
    size_px = placed.size_px
    drawn = torch.zeros(count, 1, size_px, size_px, device=rows.device)
    for screen in (placed.screen[rows], placed.shadow_screen[rows]):
        window = windows_around(screen)
        samples = window.samples(screen, 1)
        seen = rasterise(samples, samples.new_zeros(samples.shape[:2]), faces, window.size)
        x = window.origin[seen.vehicle, 0] + seen.x
        y = window.origin[seen.vehicle, 1] + seen.y
        inside = (x >= 0) & (x < size_px) & (y >= 0) & (y < size_px)
        scene = placed.scene[rows][seen.vehicle]
        drawn[scene[inside], 0, y[inside], x[inside]] = 1.0
    return F.max_pool2d(drawn, 2 * _BLUR_PX + 1, stride=1, padding=_BLUR_PX) > 0
