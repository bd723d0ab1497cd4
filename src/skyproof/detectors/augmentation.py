"""Training augmentation: exact flips and quarter turns, and mild photometric jitter."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def turn(
    image: Float[Tensor, "3 H W"], boxes: Float[Tensor, "n 4"], *, quarter_turns: int, mirror: bool
) -> tuple[Float[Tensor, "3 H2 W2"], Float[Tensor, "n 4"]]:
    """Mirrors left to right, then turns counter-clockwise by quarters; boxes follow exactly."""
    if mirror:
        image = image.flip(2)
        width = image.shape[2]
        boxes = torch.stack(
            [width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], dim=1
        )
    for _ in range(quarter_turns % 4):
        width = image.shape[2]
        image = image.rot90(1, (1, 2))
        boxes = torch.stack(
            [boxes[:, 1], width - boxes[:, 2], boxes[:, 3], width - boxes[:, 0]], dim=1
        )
    return image, boxes


def jitter(
    images: Float[Tensor, "B 3 H W"], strength: float, *, generator: torch.Generator
) -> Float[Tensor, "B 3 H W"]:
    """Changes light and colour of each image, and blurs or adds noise to some.

    Every image (sRGB in [0, 1]) draws its own brightness, contrast, gamma and colour. Real and
    rendered imagery differ in all of these, so a detector should not depend on them. Strength 0
    leaves the images unchanged; 1 is mild (brightness ±0.1, contrast and gamma ±25 %, colour ±10 %;
    a quarter blurred by up to 1.3 px, three in ten with noise of up to 0.03).
    """
    if strength == 0:
        return images
    count = len(images)

    def draw(low: float, high: float, channels: int = 1) -> Tensor:
        values = torch.rand(count, channels, 1, 1, generator=generator) * (high - low) + low
        return values.to(images) * strength

    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    images = (images - mean) * draw(-0.25, 0.25).exp() + mean + draw(-0.1, 0.1)
    images = images * draw(-0.1, 0.1, channels=3).exp()
    images = images.clamp(1e-4, 1) ** draw(-0.25, 0.25).exp()
    grey = images.mean(dim=1, keepdim=True)
    images = grey + (images - grey) * draw(-0.4, 0.3).exp()
    sigmas_px = draw(0.3, 1.3).flatten().tolist()
    blurred = (torch.rand(count, generator=generator) < 0.25).tolist()
    images = torch.stack(
        [
            _blur(image[None], sigma_px)[0] if chosen else image
            for image, sigma_px, chosen in zip(images, sigmas_px, blurred, strict=True)
        ]
    )
    noisy = torch.rand(count, generator=generator) < 0.3
    deviation = draw(0.0, 0.03)[noisy.to(images.device)]
    # The CPU draws, so that every device trains on the same images.
    noise = torch.randn((int(noisy.sum()), *images.shape[1:]), generator=generator).to(images)
    images[noisy.to(images.device)] += noise * deviation
    return images.clamp(0, 1)


def _blur(images: Tensor, sigma_px: float) -> Tensor:
    radius = max(1, math.ceil(2 * sigma_px))
    offsets = torch.arange(-radius, radius + 1, dtype=images.dtype, device=images.device)
    kernel = torch.exp(-(offsets**2) / (2 * sigma_px**2))
    kernel = (kernel / kernel.sum()).expand(3, 1, 1, -1)
    padded = functional.pad(images, (radius,) * 4, mode="replicate")
    return functional.conv2d(
        functional.conv2d(padded, kernel, groups=3), kernel.transpose(2, 3), groups=3
    )
