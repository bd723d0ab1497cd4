"""Lays path-traced crops over the photograph, in linear light (section S2)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.lighting import SceneLights
from skyproof.render.sensor import blurred, sensor_noise
from skyproof.scenes.sensor import Sensor

_LEAST_WEIGHT = 1e-3


@torch.no_grad()
def composite_crops(
    photograph: Float[Tensor, "3 H W"],
    crops: Sequence[tuple[tuple[int, int, int, int], Float[Tensor, "7 _h _w"]]],
    seed: int,
    margin_px: int,
    sensor: Sensor,
    lights: SceneLights,
) -> Float[Tensor, "3 H W"]:
    """Lays crops over one image: I = I_bg * (1 - G(taken)) + G(colour), in linear light.

    `taken` is the share of the ground's light that a crop takes per channel: all behind vehicles,
    and 1 - ratio beside them, where ratio is the light there over the light without vehicles.
    Pixels out of reach keep the photograph's value exactly. Vehicles get the sensor's noise.

    Args:
        crops: left, top, width, height in image pixels, and linear colour times coverage (3),
            coverage (1), ratio (3). Each crop shows everything in its window, so either is right in
            an overlap.
        margin_px: width over which the rest of the ratio fades out towards a crop's edge; not at
            the image's border, where the shadow continues.
    """
    if not crops:
        return photograph
    radius, size = sensor.blur_radius_px, photograph.shape[-1]
    wide = size + 2 * radius
    total = photograph.new_zeros(7, wide, wide)
    weight = photograph.new_zeros(wide, wide)
    nearest = photograph.new_zeros(wide, wide)
    for (left, top, width, height), layers in crops:
        rows = slice(top + radius, top + radius + height)
        columns = slice(left + radius, left + radius + width)
        ends = [
            (first <= -radius, first + length >= size + radius)
            for first, length in ((top, height), (left, width))
        ]
        vertical = _inwards(height, margin_px, ends[0], layers)
        inside = vertical[:, None] * _inwards(width, margin_px, ends[1], layers)
        trust = inside + _LEAST_WEIGHT
        total[:, rows, columns] += layers * trust
        weight[rows, columns] += trust
        nearest[rows, columns] = torch.maximum(nearest[rows, columns], inside)
    mean = total / weight.clamp(min=_LEAST_WEIGHT)
    colour, alpha, ratio = mean.split((3, 1, 3))
    taken = alpha + (1 - alpha) * (1 - ratio) * nearest * (weight > 0)
    middle = torch.tensor([[radius, radius]], device=photograph.device)
    colour, alpha, taken = (
        blurred(layer[None], [sensor], middle, (size, size))[0] for layer in (colour, alpha, taken)
    )
    ground = lights.received(srgb_to_linear(photograph)[None])
    mixed = (ground * (1 - taken) + colour).clamp(min=0.0)
    pixels = linear_to_srgb(lights.shown(mixed))[0]
    if sensor.noise > 0:
        steps = torch.arange(size, device=photograph.device)[None]
        noise = sensor_noise([seed], steps, steps, photograph[None])[0]
        pixels = pixels + sensor.noise * alpha * noise
    reached = (taken != 0).any(0) | (alpha[0] > 0)
    return torch.where(reached, pixels.clamp(0.0, 1.0), photograph)


def _inwards(
    length: int, margin: int, cut: tuple[bool, bool], like: Tensor
) -> Float[Tensor, " length"]:
    """Rises from 0 outside the first pixel to 1 beyond the margin, and falls at an uncut end."""
    step = torch.arange(length, device=like.device, dtype=like.dtype) + 0.5
    from_first, from_last = (
        torch.full_like(step, torch.inf) if end else way
        for end, way in zip(cut, (step, length - step), strict=True)
    )
    return (torch.minimum(from_first, from_last) / max(margin, 1)).clamp(max=1.0)
