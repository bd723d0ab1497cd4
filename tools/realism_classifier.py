"""A small network that tells rendered windows from real ones, for tools/realism.py."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from realism_crops import Crop
from realism_folds import Fold
from torch import Tensor, nn
from torch.nn import functional

from skyproof.randomness import generator_of

View = Literal["whole", "vehicle", "ground"]
"""What a network sees of a window: all, the vehicle in its box alone, or all but that box."""

_BATCH = 64
_CHANNELS = (12, 24, 32, 64, 112)
# Boxes are grown at random by this much on every side, so that how tightly a box was drawn by hand
# does not tell real from rendered.
_MARGINS_M = (0.2, 0.8)
_ERASED_M = 1.5


class Network(nn.Sequential):
    """Four blocks of convolutions, some 90,000 parameters; a positive value means rendered.

    Squares of 2 x 2 pixels become channels first, which loses nothing and halves the time.
    """

    def __init__(self) -> None:
        blocks: list[nn.Module] = [nn.PixelUnshuffle(2)]
        for before, after in itertools.pairwise(_CHANNELS):
            blocks += [
                nn.Conv2d(before, after, 3, padding=1, bias=False),
                nn.BatchNorm2d(after, momentum=0.2),
                nn.ReLU(inplace=True),
                nn.MaxPool2d(2),
            ]
        # In place of the last pooling, the mean over all of the window.
        blocks[-1] = nn.AdaptiveAvgPool2d(1)
        super().__init__(*blocks, nn.Flatten(), nn.Linear(_CHANNELS[-1], 1))
        self.to(memory_format=torch.channels_last)


class Windows:
    """Windows as tensors, from which batches are drawn.

    Args:
        crops: the windows, all of one size.
        room_px: how far they may be shifted.
        gsd_m: metres per pixel.
    """

    def __init__(self, crops: Sequence[Crop], room_px: int, gsd_m: float) -> None:
        self.pixels = torch.stack([crop.pixels for crop in crops])
        self.boxes = torch.tensor([crop.box for crop in crops])
        self.room_px = room_px
        self.gsd_m = gsd_m

    def draw(
        self, indices: Tensor, view: View, *, learning: bool, generator: torch.Generator
    ) -> Tensor:
        """Returns windows with all that is not to tell anything drawn at random.

        Shift (a window is symmetric, so that is no quarter turn's business), quarter turn and
        mirror, how much of the box's surroundings is shown; and when learning, brightness and a
        grey patch as well.

        Args:
            indices: `[n]` which.
            view: what is shown of them; all else becomes grey.
            learning: whether to vary more.
            generator: of the draws.

        Returns:
            `[n, 3, s, s]` values around 0, which is grey.
        """
        count = len(indices)
        images = self.pixels[indices].float() / 127.5 - 1
        if view != "whole":
            low, high = (margin / self.gsd_m for margin in _MARGINS_M)
            margins = low + (high - low) * torch.rand(count, 4, generator=generator)
            sign = torch.tensor([-1.0, -1.0, 1.0, 1.0])
            inside = _inside(self.boxes[indices] + sign * margins, images.shape[2])
            images = images * (inside if view == "vehicle" else ~inside)
        size = images.shape[2] - 2 * self.room_px
        shift = torch.randint(2 * self.room_px + 1, (count, 2), generator=generator).tolist()
        turn = torch.randint(8, (count,), generator=generator).tolist()
        images = torch.stack(
            [
                _turned(image[:, y : y + size, x : x + size], turned)
                for image, (x, y), turned in zip(images, shift, turn, strict=True)
            ]
        )
        if learning:
            shown = images != 0
            gain = 0.85 + 0.3 * torch.rand(count, 1, 1, 1, generator=generator)
            lift = 0.15 * torch.rand(count, 1, 1, 1, generator=generator) - 0.075
            # What is hidden stays grey.
            images = torch.where(shown, images * gain + lift, images)
            side = round(_ERASED_M / self.gsd_m)
            corner = torch.randint(size - side + 1, (count, 2), generator=generator).float()
            patch = _inside(torch.cat([corner, corner + side], 1), size)
            erased = torch.rand(count, 1, 1, 1, generator=generator) < 0.5
            images = images.masked_fill(patch & erased, 0.0)
        return images.contiguous(memory_format=torch.channels_last)

    def middle(self, indices: Tensor) -> Tensor:
        """Returns windows as they are, not shifted: `[n, 3, s, s]` values around 0."""
        room = self.room_px
        images = self.pixels[indices].float() / 127.5 - 1
        inner = images[:, :, room : images.shape[2] - room, room : images.shape[3] - room]
        return inner.contiguous(memory_format=torch.channels_last)


def learn(
    windows: Windows,
    rendered: NDArray[np.bool_],
    spot_of: NDArray[np.int64],
    fold: Fold,
    view: View,
    *,
    steps: int,
    seed: int,
) -> Network:
    """Trains a network on a fold's windows, as many rendered as real ones in every batch.

    Args:
        windows: all of them.
        rendered: `[N]` what is to be told.
        spot_of: `[N]` each window's spot; every spot is drawn as often, however many windows show
            it.
        fold: which may be learnt from.
        view: what is shown of each.
        steps: of the optimiser.
        seed: of weights and draws.
    """
    weights = generator_of(seed, "weights", view, fold.name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(weights.initial_seed())
        network = Network()
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    generator = generator_of(seed, "batches", view, fold.name)
    pools = []
    for wanted in (False, True):
        pool = np.flatnonzero(fold.train & (rendered == wanted))
        often = 1 / np.bincount(spot_of[pool])[spot_of[pool]]
        pools.append((torch.from_numpy(pool), torch.from_numpy(often)))
    target = torch.cat([torch.zeros(_BATCH // 2), torch.ones(_BATCH // 2)])
    network.train()
    for _ in range(steps):
        drawn = [
            pool[often.multinomial(_BATCH // 2, replacement=True, generator=generator)]
            for pool, often in pools
        ]
        images = windows.draw(torch.cat(drawn), view, learning=True, generator=generator)
        loss = functional.binary_cross_entropy_with_logits(network(images)[:, 0], target)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    network.eval()
    return network


@torch.no_grad()
def judge(
    network: Network, windows: Windows, indices: NDArray[np.int64], view: View, *, seed: int
) -> NDArray[np.float64]:
    """Returns `[n]` the mean logit of some windows over eight draws of each."""
    generator = generator_of(seed, "judge", view)
    chosen = torch.from_numpy(indices)
    total = torch.zeros(len(indices))
    for _ in range(8):
        drawn = windows.draw(chosen, view, learning=False, generator=generator)
        total += network(drawn)[:, 0]
    mean: NDArray[np.float64] = (total / 8).double().numpy()
    return mean


@torch.no_grad()
def occlusion(
    network: Network, windows: Windows, indices: NDArray[np.int64], patch_px: int, stride_px: int
) -> NDArray[np.float64]:
    """Hides each part of windows in turn behind a grey patch.

    Returns:
        `[n, m, m]` by how much the logit falls, per window and place of the patch.
    """
    images = windows.middle(torch.from_numpy(indices))
    places = range(0, images.shape[2] - patch_px + 1, stride_px)
    whole = network(images)[:, 0]
    rows = []
    for y in places:
        for x in places:
            hidden = images.clone(memory_format=torch.preserve_format)
            hidden[:, :, y : y + patch_px, x : x + patch_px] = 0.0
            rows.append(whole - network(hidden)[:, 0])
    count = len(places)
    falls: NDArray[np.float64] = torch.stack(rows, 1).view(-1, count, count).double().numpy()
    return falls


def _inside(boxes: Tensor, size: int) -> Tensor:
    """Returns `[n, 1, size, size]` which pixels have their centre in each box."""
    steps = torch.arange(size) + 0.5
    left, top, right, bottom = boxes[:, :, None].unbind(1)
    columns = (steps >= left) & (steps < right)
    rows = (steps >= top) & (steps < bottom)
    return (rows[:, :, None] & columns[:, None, :])[:, None]


def _turned(image: Tensor, turn: int) -> Tensor:
    """Turns by quarters, and mirrors where `turn` is 4 or more."""
    image = image.flip(2) if turn >= 4 else image
    return image.rot90(turn % 4, (1, 2))
