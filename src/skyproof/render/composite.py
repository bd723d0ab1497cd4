"""Vehicles and shadows laid over the photograph, in linear light, as the sensor shows them.

Crowns and roofs of the photograph hide parts of the vehicles that stand beneath.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from skyproof.geometry.rasterise import rasterise
from skyproof.geometry.triangles import NOTHING_KEY
from skyproof.kernels import rows, struct
from skyproof.render.frames import Images
from skyproof.render.kernels.canvas import (
    ImageLayers,
    SensorWindows,
    blur,
    finish_pixels,
    finish_pixels_back,
    lay,
    lay_back,
)
from skyproof.render.layers import WindowLayers
from skyproof.render.lighting import SceneLights
from skyproof.render.linear_texture import tables
from skyproof.render.placed import Placed, Windows, windows_around
from skyproof.render.sensor import blur_weights, noise_tiles
from skyproof.scenes.scene import BackgroundWindow, Scene
from skyproof.scenes.sensor import Sensor

# Pixels around a vehicle and its shadow that the sensor's blur reaches.
_BLUR_PX = 2


def composite(
    photographs: Float[Tensor, "B 3 S S"],
    *,
    bodies: WindowLayers,
    shadows: WindowLayers,
    scene: Int[Tensor, " N"],
    nearness: Float[Tensor, " N"],
    seeds: Sequence[int],
    lights: SceneLights,
    sensors: Sequence[Sensor],
    cover: Float[Tensor, "B 1 S S"] | None = None,
) -> Float[Tensor, "B 3 S S"]:
    """Lays blurred vehicles over the photographs, and adds noise where something was rendered.

    I = I_bg * kept * (1 - G(coverage)) + G(coverage * colour), in linear light, where kept is the
    sun and sky that the blurred shadows leave. Black, white and shoulder are those of the
    photograph's light. A pixel out of reach keeps the photograph's value exactly. A nearer vehicle
    hides a farther one. Shadows fall on the ground alone. It is differentiable in bodies and
    shadows.

    Differences from the paper: I_bg + G(I_fg - I_bg) (section 3.2) is the same on even ground, but
    lane markings shine through the vehicle. Here the photograph is hidden by as much as the blurred
    vehicle covers it.

    Args:
        photographs: sRGB; written over.
        nearness: orders the vehicles of an image; larger is nearer to the camera.
        seeds: seeds of the noise, one per image.
        cover: share of each pixel in which the photograph hides vehicles and shadows.
    """
    count, size_px = len(photographs), photographs.shape[-1]
    ground = None if cover is None else photographs.clone()
    # Each image has one window around all that is drawn near it, and a larger one for its blur, of
    # which only the part inside the photograph is computed.
    margin_px = max(sensor.blur_radius_px for sensor in sensors)
    origin, size = _whole((bodies.window, shadows.window), scene, count, size_px, margin_px + 1)
    shown_px = min(size + 2 * margin_px, size_px)
    shown = (origin - margin_px).clamp(0, size_px - shown_px)
    before = torch.bincount(scene, minlength=count).cumsum(0)
    order = torch.argsort(nearness, stable=True)
    canvas = struct(
        ImageLayers,
        first=F.pad(before, (1, 0)).int(),
        vehicles=order[torch.argsort(scene[order], stable=True)].int(),
        origins=origin.int(),
        bodies=bodies.values.detach(),
        body_origins=bodies.window.origin.int(),
        shadows=shadows.values.detach(),
        shadow_origins=shadows.window.origin.int(),
    )
    differentiable = bodies.values.requires_grad or shadows.values.requires_grad
    keep = differentiable and torch.is_grad_enabled()
    drawn = photographs.new_empty(count, shown_px, shown_px, 6)
    strength = drawn.new_tensor([[sensor.noise] for sensor in sensors])
    shows = (lights.white, lights.black, lights.sky, lights.shoulder, strength)
    kept = drawn.new_empty(2, *drawn.shape[:3] if keep else (0, 0, 0), 3)
    picture = struct(
        SensorWindows,
        corners=shown.int(),
        drawn=drawn,
        shows=torch.cat(shows, dim=1),
        noise=noise_tiles(seeds).to(drawn),
        linear=tables(drawn.device)["linear"],
        ground=kept[0],
        slopes=kept[1],
    )
    weights = blur_weights(sensors, margin_px, drawn)
    sheet = _Sheet(canvas, size, weights, (shown - origin).int(), picture, drawn, keep)
    image = _Laid.apply(bodies.values, shadows.values, photographs, sheet)
    return image if cover is None or ground is None else hidden(image, ground, cover)


@dataclass(frozen=True)
class _Sheet:
    """A canvas of `size` and the picture that a blur makes of it, from `offsets` (x, y) on."""

    canvas: Any
    size: int
    weights: Float[Tensor, "B _"]
    offsets: Int[Tensor, "B 2"]
    picture: Any
    drawn: Float[Tensor, "B h w 6"]
    keep: bool

    def blur(
        self, offsets: Int[Tensor, "B 2"], axis: int, given: Tensor, blurred: Tensor
    ) -> Tensor:
        """Blurs along rows (0) or columns (1)."""
        rows(blur, blurred.shape, self.weights, offsets, axis, given, blurred)
        return blurred


class _Laid(torch.autograd.Function):
    """Vehicles and shadows laid over photographs, which are written over."""

    @staticmethod
    def forward(
        context: Any,
        bodies: Float[Tensor, "N S S 4"],
        shadows: Float[Tensor, "N Z Z 2"],
        photographs: Float[Tensor, "B 3 H W"],
        sheet: _Sheet,
    ) -> Float[Tensor, "B 3 H W"]:
        count, _, width, _ = sheet.drawn.shape
        laid = photographs.new_empty(count, sheet.size, sheet.size, 6)
        rows(lay, laid.shape, sheet.canvas, laid)
        along = sheet.blur(sheet.offsets, 0, laid, laid.new_empty(count, sheet.size, width, 6))
        sheet.blur(sheet.offsets, 1, along, sheet.drawn)
        rows(finish_pixels, sheet.drawn.shape, sheet.picture, sheet.keep, photographs)
        context.mark_dirty(photographs)
        context.sheet, context.shapes = sheet, (bodies.shape, shadows.shape)
        return photographs

    @staticmethod
    @once_differentiable
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        sheet, gradient = context.sheet, gradients[0].contiguous()
        count, _, width, _ = sheet.drawn.shape
        to_drawn = torch.empty_like(sheet.drawn)
        rows(finish_pixels_back, to_drawn.shape, sheet.picture, gradient, to_drawn)
        # The same blur, from the pictures to the canvases.
        along = to_drawn.new_empty(count, sheet.size, width, 6)
        sheet.blur(-sheet.offsets, 1, to_drawn, along)
        laid = to_drawn.new_empty(count, sheet.size, sheet.size, 6)
        sheet.blur(-sheet.offsets, 0, along, laid)
        to_bodies, to_shadows = (gradient.new_zeros(shape) for shape in context.shapes)
        rows(lay_back, laid.shape, sheet.canvas, laid, to_bodies, to_shadows)
        return to_bodies, to_shadows, None, None


@torch.no_grad()
def _whole(
    windows: Sequence[Windows], scene: Int[Tensor, " N"], count: int, size_px: int, margin_px: int
) -> tuple[Int[Tensor, "B 2"], int]:
    """Returns one window per image around all small ones: its top-left pixel, and the size of all.

    They reach beyond an image by no more than a margin, because the rest shows nowhere.
    """
    index = scene[:, None].expand(-1, 2)
    far = torch.iinfo(torch.long).max // 4
    low = torch.full((count, 2), far, dtype=torch.long, device=scene.device)
    high = -low
    for window in windows:
        low = low.scatter_reduce(0, index, window.origin, "amin")
        high = high.scatter_reduce(0, index, window.origin + window.size, "amax")
    empty = low == far
    low, high = (
        each.masked_fill(empty, 0).clamp(-margin_px, size_px + margin_px) for each in (low, high)
    )
    return low, max(1, int((high - low).max()))


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
    found = placed.vertices.new_zeros(len(scenes), 1, size_px, size_px)
    for index, scene in enumerate(scenes):
        if any(placement.covered for placement in scene.placements):
            cover = cover_of(scene.background, size_px)
            if cover is not None:
                found[index, 0] = cover
    some = found.flatten(1).any(1)
    if not some.any():
        return None
    # Vehicles on top, in the scenes in which others stand beneath.
    covered = torch.tensor(
        [placement.covered for scene in scenes for placement in scene.placements],
        device=found.device,
    )
    rows = torch.nonzero((covered == 0) & some[placed.scene])[:, 0]
    if len(rows):
        found = found.masked_fill(_drawn(placed, rows, faces, len(scenes)), 0.0)
    return found


def hidden(image: Images, photographs: Images, cover: Float[Tensor, "B 1 H W"]) -> Images:
    """Lays the photograph's cover over the vehicles again; other pixels keep their bits."""
    return torch.where(cover > 0, torch.lerp(image, photographs, cover), image)


def _drawn(
    placed: Placed, rows: Int[Tensor, " K"], faces: Int[Tensor, "F 3"], count: int
) -> Bool[Tensor, "B 1 H W"]:
    """Returns the pixels of some vehicles and their shadows, widened by the reach of the blur."""
    size_px = placed.size_px
    drawn = torch.zeros(count, 1, size_px, size_px, device=rows.device)
    for screen in (placed.screen[rows], placed.shadow_screen[rows]):
        window = windows_around(screen)
        samples = window.samples(screen, 1)
        keys = rasterise(samples, samples.new_zeros(samples.shape[:2]), faces, window.size)
        vehicle, row, column = torch.nonzero(keys != NOTHING_KEY, as_tuple=True)
        x, y = window.origin[vehicle, 0] + column, window.origin[vehicle, 1] + row
        inside = (x >= 0) & (x < size_px) & (y >= 0) & (y < size_px)
        scene = placed.scene[rows][vehicle]
        drawn[scene[inside], 0, y[inside], x[inside]] = 1.0
    return F.max_pool2d(drawn, 2 * _BLUR_PX + 1, stride=1, padding=_BLUR_PX) > 0
