"""The images of one training step: order, windows of large images, masking, augmentation."""

import math
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import PADDING_GREY, WINDOW_PX
from skyproof.detectors.settings import TrainingSettings
from skyproof.randomness import generator_of

Batch = tuple[Float[Tensor, "B 3 H W"], list[Float[Tensor, "_n 4"]]]
"""Images, sRGB in [0, 1], and the boxes of each, pixel xyxy."""


@runtime_checkable
class DrawnImages(Protocol):
    """Labelled images rendered as they are needed; the digest is that of ground and vehicles."""

    @property
    def digest(self) -> str: ...

    @property
    def gsd_m(self) -> float: ...

    @property
    def size_px(self) -> tuple[int, int]: ...

    def images(self, count: int, *, generator: torch.Generator, device: torch.device) -> Batch: ...


def training_batches(
    training: Dataset | None,
    drawn: DrawnImages | None,
    settings: TrainingSettings,
    seed: int,
    device: torch.device,
    step: int,
) -> list[Batch]:
    """Makes the images of one step, counted from 0; half of them are drawn if there are others.

    Drawn ones are on `device`.
    """
    left, batches = settings.batch_size, []
    if training is not None:
        shown = left if drawn is None else left - left // 2
        batches.append(training_batch(training, replace(settings, batch_size=shown), seed, step))
        left -= shown
    if drawn is not None and left:
        generator = generator_of(seed, "plain", step)
        images, boxes = drawn.images(left, generator=generator, device=device)
        batches.append((jitter(images, settings.jitter, generator=generator), boxes))
    return batches


def training_batch(training: Dataset, settings: TrainingSettings, seed: int, step: int) -> Batch:
    """Makes the images and boxes of one step, counted from 0.

    They depend on seed and step alone, so that a resumed training is exact. An image wider or
    higher than 384 px (the paper's tile, section 5.2) is cut to a random window; smaller images are
    padded with grey to the largest of the batch. Images are sRGB in [0, 1], boxes `[n, 4]` pixel
    xyxy.
    """
    # Every epoch shuffles the images anew.
    count = len(training)
    positions = range(step * settings.batch_size, (step + 1) * settings.batch_size)
    orders = {}
    for epoch in {position // count for position in positions}:
        shuffle = torch.Generator().manual_seed((seed + epoch) % 2**63)
        orders[epoch] = torch.randperm(count, generator=shuffle)
    generator = torch.Generator().manual_seed((seed ^ 0x5EED) + 7919 * step)
    indices = [int(orders[position // count][position % count]) for position in positions]
    # Each image is cut to a window, its ignore regions are masked, and it is turned and mirrored.
    images: list[Tensor] = []
    targets: list[Tensor] = []
    for index, decoded in zip(indices, training.images(indices), strict=True):
        vehicles = training.boxes[index].float()
        # A box out of sight or beyond a border has no area, and its loss would not be finite.
        in_sight = (vehicles[:, 2:] > vehicles[:, :2]).all(dim=1)
        ignored = training.ignore[index].float()
        shown, boxes, ignore = window(decoded, vehicles[in_sight], ignored, generator=generator)
        image = _hide_ignored(shown.float() / 255, boxes, ignore)
        turns = int(torch.randint(8, (1,), generator=generator))
        mirror = bool(torch.rand(1, generator=generator) < 0.5)
        image, boxes = turn(image, boxes, quarter_turns=turns, mirror=mirror)
        images.append(image)
        targets.append(boxes)
    # All images in one tensor, each with its own change of light and colour.
    height = max(image.shape[1] for image in images)
    width = max(image.shape[2] for image in images)
    batch = torch.full((len(images), 3, height, width), PADDING_GREY)
    for row, image in zip(batch, images, strict=True):
        row[:, : image.shape[1], : image.shape[2]] = image
    return jitter(batch, settings.jitter, generator=generator), targets


def window(
    image: Tensor, boxes: Tensor, ignore: Tensor, *, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Cuts a random window of at most 384 px a side from an image `[3, H, W]` of any type.

    A smaller image is returned unchanged, without a draw. If there are vehicles, half of the
    windows are placed over one, so that wide images with few vehicles do not show ground alone. A
    box (pixel xyxy) that the window's edge cuts becomes an ignore region.
    """
    height, width = image.shape[1:]
    high = min(height, WINDOW_PX)
    wide = min(width, WINDOW_PX)
    if (high, wide) == (height, width):
        return image, boxes, ignore
    left = _draw(width - wide, generator)
    top = _draw(height - high, generator)
    if len(boxes) and _draw(1, generator):
        # The vehicle's place in the window is random, so that the detector cannot learn it.
        x1, y1, x2, y2 = boxes[_draw(len(boxes) - 1, generator)].tolist()
        left = _over(x1, x2, wide, width, generator)
        top = _over(y1, y2, high, height, generator)
    shift = torch.tensor([left, top, left, top], dtype=boxes.dtype)
    moved, hidden = boxes - shift, ignore - shift
    limits = torch.tensor([wide, high, wide, high], dtype=boxes.dtype)
    # Labels may reach slightly over the image's own edge.
    edge = torch.tensor([left == 0, top == 0, left + wide == width, top + high == height])
    inside = torch.cat([moved[:, :2] >= 0, moved[:, 2:] <= limits[2:]], dim=1) | edge
    whole = inside.all(dim=1)
    hidden = torch.cat([hidden, moved[~whole]])
    seen = ((hidden[:, :2] < limits[:2]) & (hidden[:, 2:] > 0)).all(dim=1)
    hidden = torch.minimum(hidden[seen].clamp(min=0), limits)
    return image[:, top : top + high, left : left + wide], moved[whole], hidden


def _draw(most: int, generator: torch.Generator) -> int:
    """Draws an integer from 0 to `most`."""
    return int(torch.randint(most + 1, (1,), generator=generator))


def _over(low: float, high: float, side: int, length: int, generator: torch.Generator) -> int:
    """Draws the start of a window of `side` within `length` that holds `low` to `high` whole."""
    first = min(max(0, math.ceil(high) - side), length - side)
    last = max(first, min(math.floor(low), length - side))
    return first + _draw(last - first, generator)


def _hide_ignored(image: Tensor, boxes: Tensor, ignore: Tensor) -> Tensor:
    """Paints ignore regions with the mean colour, so that they are neither vehicle nor ground."""
    if not len(ignore):
        return image
    hidden = torch.zeros(image.shape[1:], dtype=torch.bool)
    for regions, value in ((ignore, True), (boxes, False)):
        for left, top, right, bottom in regions.clamp(min=0).tolist():
            hidden[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)] = value
    return torch.where(hidden, image.mean(dim=(1, 2), keepdim=True), image)


def turn(
    image: Float[Tensor, "3 H W"], boxes: Float[Tensor, "n 4"], *, quarter_turns: int, mirror: bool
) -> tuple[Float[Tensor, "3 H2 W2"], Float[Tensor, "n 4"]]:
    """Mirrors left to right, then turns counter-clockwise by quarters; boxes follow exactly."""
    if mirror:
        left, top, right, bottom = boxes.unbind(1)
        boxes = torch.stack([image.shape[2] - right, top, image.shape[2] - left, bottom], dim=1)
        image = image.flip(2)
    for _ in range(quarter_turns % 4):
        left, top, right, bottom = boxes.unbind(1)
        boxes = torch.stack([top, image.shape[2] - right, bottom, image.shape[2] - left], dim=1)
        image = image.rot90(1, (1, 2))
    return image, boxes


def jitter(
    images: Float[Tensor, "B 3 H W"], strength: float, *, generator: torch.Generator
) -> Float[Tensor, "B 3 H W"]:
    """Changes light and colour of each image, and blurs or adds noise to some.

    Real and rendered imagery differ in all of these, so a detector should not depend on them.
    Strength 0 leaves the images unchanged; 1 is mild (brightness ±0.1, contrast and gamma ±25 %,
    colour ±10 %; a quarter blurred by up to 1.3 px, three in ten with noise of up to 0.03).
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
