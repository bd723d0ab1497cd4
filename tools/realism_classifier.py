"""A small network that tells rendered windows from real ones, for tools/realism.py."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from realism_crops import Crop
from realism_folds import Fold, spots
from torch import Tensor, nn
from torch.nn import functional

from skyproof.randomness import generator_of

View = Literal["whole", "vehicle", "ground"]
"""What a network sees of a window: all, the vehicle alone, or all but the vehicle."""

_BATCH = 64
_CHANNELS = (12, 24, 32, 64, 112)
# A disc, because a box would tell the heading and how tightly somebody drew it. It holds a car of
# 4.8 m with the ground at its sides; where its middle lies is drawn at random, too.
_VEHICLE_M = 2.4
_SLACK_M = 0.25
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
        self.spot_of = spots(crops)
        self.room_px = room_px
        self.gsd_m = gsd_m
        boxes = torch.tensor([crop.box for crop in crops])
        # From the window's middle.
        self.middles = (boxes[:, :2] + boxes[:, 2:]) / 2 - self.pixels.shape[2] / 2

    def draw(
        self, indices: Tensor, view: View, *, learning: bool, generator: torch.Generator
    ) -> Tensor:
        """Returns windows with all drawn at random that is not to tell anything.

        That is heading, mirror and shift; so real windows are resampled as rendered ones are. When
        learning, brightness varies and a patch is hidden as well.

        Args:
            indices: `[n]` which.
            view: what is shown of them; all else becomes grey, and so does what is farther from the
                middle than half a window, which turns would show at some angles only.
            learning: whether to vary more.
            generator: of the draws.

        Returns:
            `[n, 3, s, s]` values around 0, which is grey.
        """
        count = len(indices)
        whole = self.pixels.shape[2]
        size = whole - 2 * self.room_px
        angle = 2 * math.pi * torch.rand(count, generator=generator)
        mirror = 2.0 * torch.randint(2, (count,), generator=generator) - 1
        shift = self.room_px * (2 * torch.rand(count, 2, generator=generator) - 1)
        turn = torch.stack([angle.cos() * mirror, angle.sin(), -angle.sin() * mirror, angle.cos()])
        # Per pixel of the result, in pixels: the place in it and in the window, from the middle.
        steps = torch.arange(size) + 0.5 - size / 2
        place = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)
        there = place @ turn.T.view(count, 1, 2, 2).mT + shift[:, None, None]
        grid = there * (2 / whole)
        images = functional.grid_sample(
            self.pixels[indices].float() / 127.5 - 1, grid, mode="bicubic", align_corners=False
        )
        if learning:
            gain = 0.85 + 0.3 * torch.rand(count, 1, 1, 1, generator=generator)
            lift = 0.15 * torch.rand(count, 1, 1, 1, generator=generator) - 0.075
            images = images * gain + lift
        shown = (place.square().sum(-1) <= (size / 2) ** 2).expand(count, size, size)
        if view != "whole":
            slack = 2 * torch.rand(count, 2, generator=generator) - 1
            middle = self.middles[indices] + slack * (_SLACK_M / self.gsd_m)
            away = (there - middle[:, None, None]).square().sum(-1)
            vehicle = away <= (_VEHICLE_M / self.gsd_m) ** 2
            shown = shown & (vehicle if view == "vehicle" else ~vehicle)
        if learning:
            side = round(_ERASED_M / self.gsd_m)
            corner = torch.randint(size - side + 1, (count, 2), generator=generator)
            patch = _squares(corner, side, size)
            erased = torch.rand(count, 1, 1, generator=generator) < 0.5
            shown = shown & ~(patch & erased)
        images = images * shown[:, None]
        return images.contiguous(memory_format=torch.channels_last)

    def middle(self, indices: Tensor) -> Tensor:
        """Returns windows as they are, neither turned nor shifted: `[n, 3, s, s]` around 0."""
        room = self.room_px
        images = self.pixels[indices].float() / 127.5 - 1
        inner = images[:, :, room : images.shape[2] - room, room : images.shape[3] - room]
        size = inner.shape[2]
        steps = torch.arange(size) + 0.5 - size / 2
        disc = steps[:, None].square() + steps.square() <= (size / 2) ** 2
        return (inner * disc).contiguous(memory_format=torch.channels_last)


def learn(
    windows: Windows,
    rendered: NDArray[np.bool_],
    fold: Fold,
    view: View,
    *,
    steps: int,
    seed: int,
) -> Network:
    """Trains a network on a fold's windows, as many rendered as real ones in every batch.

    Every spot is drawn as often, however many windows show it.

    Args:
        windows: all of them.
        rendered: `[N]` what is to be told.
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
        spot_of = windows.spot_of[pool]
        often = 1 / np.bincount(spot_of)[spot_of]
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


def _squares(corners: Tensor, side: int, size: int) -> Tensor:
    """Returns `[n, size, size]` which pixels lie in squares with these top-left corners."""
    steps = torch.arange(size)
    along = (steps >= corners[:, :, None]) & (steps < corners[:, :, None] + side)
    return along[:, 1, :, None] & along[:, 0, None, :]
