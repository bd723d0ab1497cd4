"""A scene's weather: wet ground and sky before vehicles are drawn, the rest after (section S7)."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.frames import Images
from skyproof.scenes.scene import Scene

AIRLIGHT = (0.42, 0.47, 0.54)
"""Linear light of haze seen from above, over black ground: grey with a little blue."""

_WATER_INDEX = 1.33
# Any odd constant: the picture's noise must not repeat the noise on its vehicles, which has the
# scene's own seed.
_NOISE_STREAM = 0x5DEECE66D


def wet_grounds(photographs: Images, scenes: Sequence[Scene]) -> Images:
    """Wets the ground of photographs in place where it rained; the others keep their bits."""
    for photograph, scene in zip(photographs, scenes, strict=True):
        if scene.weather.wetness > 0:
            photograph.copy_(linear_to_srgb(wet(srgb_to_linear(photograph), scene.weather.wetness)))
    return photographs


def wet(ground: Float[Tensor, "*S"], wetness: float) -> Float[Tensor, "*S"]:
    """Returns reflectance under a film of water: a / (a + n^2 (1 - a)), n = 1.33 (Ångström 1925).

    The water's surface reflects part of the light back to the ground. Dark ground keeps 0.56 to 0.7
    of its light (asphalt of 0.1: 0.59; sand of 0.4: 0.68), white ground all of it. Darker channels
    lose more, so colours deepen. The photograph's value stands for the reflectance.
    """
    darkened = ground / (ground + _WATER_INDEX**2 * (1 - ground))
    return torch.lerp(ground, darkened, wetness)


def finish_images(images: Images, scenes: Sequence[Scene]) -> Images:
    """Lays haze, exposure, noise and JPEG over pictures, in this order; clear ones keep their bits.

    Differentiable; the gradient of a pixel that exposure or noise clips is zero.
    """
    weather = [scene.weather for scene in scenes]
    if not any(w.haze or w.exposure_stops or w.noise or w.jpeg_quality for w in weather):
        return images
    return torch.stack([_finish(*each) for each in zip(images, scenes, strict=True)])


def jpeg(image: Float[Tensor, "3 H W"], quality: int) -> Float[Tensor, "3 H W"]:
    """Compresses a picture by Pillow's JPEG of a quality; its gradient passes straight through."""
    return _Jpeg.apply(image, quality)


class _Jpeg(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, image: Tensor, quality: int) -> Tensor:
        pixels = (image.detach() * 255).round().byte().permute(1, 2, 0).cpu().numpy()
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
        with Image.open(buffer) as stored:
            decoded = torch.from_numpy(np.array(stored.convert("RGB")))
        return decoded.permute(2, 0, 1).to(image.device, image.dtype) / 255

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None


def _finish(image: Float[Tensor, "3 H W"], scene: Scene) -> Float[Tensor, "3 H W"]:
    weather = scene.weather
    if weather.haze or weather.exposure_stops:
        light = srgb_to_linear(image)
        if weather.haze:
            light = torch.lerp(light, light.new_tensor(AIRLIGHT)[:, None, None], weather.haze)
        image = linear_to_srgb(light * 2.0**weather.exposure_stops)
    if weather.noise:
        generator = torch.Generator().manual_seed(scene.seed ^ _NOISE_STREAM)
        noise = torch.randn(image.shape, generator=generator).to(image)
        image = torch.add(image, noise, alpha=weather.noise).clamp(0.0, 1.0)
    return image if weather.jpeg_quality is None else jpeg(image, weather.jpeg_quality)
