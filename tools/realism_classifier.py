"""A small network that tells rendered windows from real ones, and how well, for realism.py."""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from realism_pairs import ROOM_M, WINDOW_M, Pairs
from scipy.spatial.distance import cdist
from sklearn.cluster import AgglomerativeClustering
from torch import Tensor, nn
from torch.nn import functional

from skyproof.errors import ConfigurationError
from skyproof.randomness import generator_of
from skyproof.results.statistics.intervals import Interval, bootstrap_interval, resample

View = Literal["whole", "vehicle", "ground"]
"""What is seen of a window: all but other vehicles, the vehicle alone, or no vehicle."""
VIEWS: tuple[View, ...] = ("whole", "vehicle", "ground")

_BATCH = 24  # pairs
_CHANNELS = (12, 16, 32, 48, 64)
_GAP_M = WINDOW_M + 2 * ROOM_M  # windows of training and test then share no pixel
_SPOT_M = 3.0  # across; one parked vehicle in several frames stays within
_FEWEST = 10  # pairs to learn from or to test


class Network(nn.Sequential):
    """Four blocks of convolutions, some 45,000 parameters; a positive value means rendered.

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


def spots_of(pairs: Pairs) -> NDArray[np.int64]:
    """Numbers the spots that pairs stand on, `[N]`: a parked vehicle in all frames is on one."""
    if len(pairs.grounds) < 2:
        return np.zeros(len(pairs.grounds), dtype=np.int64)
    # What is on other ground is far away.
    points = np.column_stack([pairs.positions_m, 1e6 * pairs.grounds])
    clusters = AgglomerativeClustering(None, linkage="complete", distance_threshold=_SPOT_M)
    numbers: NDArray[np.int64] = clusters.fit_predict(points)
    return numbers


def folds_of(pairs: Pairs, spots: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Gives the fold in which each pair is tested, `[N]`: as many neighbouring spots in each."""
    axis = int(np.ptp(pairs.positions_m, axis=0).argmax())
    spots_count = int(spots.max()) + 1
    along = np.array([pairs.positions_m[spots == k, axis].mean() for k in range(spots_count)])
    ground = np.array([pairs.grounds[spots == k][0] for k in range(spots_count)])
    fold_of_spot = np.empty(spots_count, dtype=np.int64)
    for number, own in enumerate(np.array_split(np.lexsort((along, ground)), count)):
        fold_of_spot[own] = number
    return fold_of_spot[spots]


def learnt_from(pairs: Pairs, tested: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Says which pairs, `[N]`, share neither ground nor a vehicle of the fleet with tested ones."""
    points = np.column_stack([pairs.positions_m, 1e6 * pairs.grounds])
    far = cdist(points, points[tested], "chebyshev").min(1) >= _GAP_M
    used = np.setdiff1d(pairs.names[tested], [""])
    free: NDArray[np.bool_] = far & ~np.isin(pairs.names, used).any(1)
    return free


def tell(
    pairs: Pairs, folds: NDArray[np.int64], view: View, *, steps: int, seeds: int
) -> tuple[NDArray[np.float64], list[Network]]:
    """Trains networks without each fold and lets them judge it.

    Args:
        pairs: all windows.
        folds: `[N]` from `folds_of`.
        view: what is seen of them.
        steps: of each training.
        seeds: how many networks a fold; their mean judges.

    Returns:
        `[N, 2]` how surely each window is rendered (logit), and the first network of each fold.

    Raises:
        ConfigurationError: a fold has too few pairs.
    """
    scores = np.zeros((len(folds), 2))
    networks = []
    for number in range(int(folds.max()) + 1):
        tested = folds == number
        train = learnt_from(pairs, tested)
        if min(tested.sum(), train.sum()) < _FEWEST:
            raise ConfigurationError(
                f"Fold {number + 1} of {folds.max() + 1} learns from {train.sum()} pairs and tests "
                f"{tested.sum()}, expected {_FEWEST} or more; give more images, a larger fleet, or "
                "another number of --folds."
            )
        own = torch.from_numpy(np.flatnonzero(tested))
        for seed in range(seeds):
            network = _learn(pairs, np.flatnonzero(train), view, steps, (number, seed))
            scores[tested] += judge(network, pairs, own, view) / seeds
            if seed == 0:
                networks.append(network)
    return scores, networks


def _learn(
    pairs: Pairs, train: NDArray[np.int64], view: View, steps: int, name: tuple[int, int]
) -> Network:
    generator = generator_of(name[1], "realism", view, str(name[0]))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(generator.initial_seed())
        network = Network()
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    pool = torch.from_numpy(train)
    network.train()
    for _ in range(steps):
        chosen = pool[torch.randint(len(pool), (_BATCH,), generator=generator)]
        room = round(ROOM_M / pairs.gsd_m)
        shift = torch.randint(-room, room + 1, (2,), generator=generator).tolist()
        turn = int(torch.randint(8, (1,), generator=generator))
        # Both windows of a pair in one batch, turned and shifted alike.
        images = seen(pairs, chosen, view, shift=(shift[0], shift[1]), turn=turn)
        target = torch.tensor([0.0, 1.0]).repeat(_BATCH)
        loss = functional.binary_cross_entropy_with_logits(network(images)[:, 0], target)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    network.eval()
    return network


def seen(
    pairs: Pairs,
    indices: Tensor,
    view: View,
    *,
    shift: tuple[int, int] = (0, 0),
    turn: int = 0,
) -> Tensor:
    """Gives what a network sees of pairs, the same pixels of both windows.

    Args:
        pairs: all windows.
        indices: `[n]` which of them.
        view: what of them; all else becomes 0, which is grey.
        shift: of the windows in pixels, down and right.
        turn: one of 8: by quarters, from 4 on mirrored first.

    Returns:
        `[2n, 3, s, s]` values around 0, of each pair the real window first.
    """
    room = round(ROOM_M / pairs.gsd_m)
    side = pairs.pixels.shape[-1] - 2 * room
    rows = slice(room + shift[0], room + shift[0] + side)
    columns = slice(room + shift[1], room + shift[1] + side)
    visible = ~pairs.hidden[indices][:, rows, columns]
    if view != "whole":
        vehicle = pairs.vehicle[indices][:, rows, columns]
        visible &= vehicle if view == "vehicle" else ~vehicle
    images = pairs.pixels[indices][..., rows, columns].float() / 127.5 - 1
    images = (images * visible[:, None, None]).flatten(0, 1)
    if turn >= 4:
        images = images.flip(3)
    return images.rot90(turn % 4, (2, 3)).contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def judge(network: Network, pairs: Pairs, indices: Tensor, view: View) -> NDArray[np.float64]:
    """Returns `[n, 2]` the mean logit over the eight ways that windows can lie."""
    total = sum(network(seen(pairs, indices, view, turn=turn))[:, 0] for turn in range(8))
    logits: NDArray[np.float64] = (total / 8).view(-1, 2).double().numpy()
    return logits


def area(
    scores: NDArray[np.float64],
    folds: NDArray[np.int64],
    spots: NDArray[np.int64],
    *,
    generator: np.random.Generator,
) -> Interval:
    """Gives the area under the ROC curve with its 95 % interval by a bootstrap over spots.

    It is the share of all couples of a rendered and a real window in which the rendered one scores
    higher; ties count half. Only windows judged by the same networks are compared, and a spot in
    many frames weighs as one in a single frame.

    Args:
        scores: `[N, 2]` of real and rendered windows.
        folds: `[N]` in which each pair was tested.
        spots: `[N]` each pair's spot.
        generator: of the bootstrap.
    """
    member = (np.unique(spots)[:, None] == spots).astype(np.float64)
    member /= member.sum(1, keepdims=True)
    together = (folds[:, None] == folds).astype(np.float64)
    won = (np.sign(scores[:, 1, None] - scores[None, :, 0]) + 1) / 2 * together
    won = member @ won @ member.T
    compared = member @ together @ member.T

    def of(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        below = ((weights @ compared) * weights).sum(1)
        above = ((weights @ won) * weights).sum(1)
        share = np.full(len(weights), np.nan)
        return np.divide(above, below, out=share, where=below > 0)

    count = len(member)
    drawn = resample(count, generator=generator).astype(np.float64)
    estimate = float(of(np.ones((1, count)))[0])
    return bootstrap_interval(estimate, of(drawn), of(1 - np.eye(count)), (0.0, 1.0))


@torch.no_grad()
def occlusion(
    network: Network, pairs: Pairs, indices: Tensor, *, patch_px: int, stride_px: int
) -> NDArray[np.float64]:
    """Hides each part of whole windows in turn.

    Returns:
        `[n, 2, m, m]` by how much the logit of the truth falls, per window and place of the patch.
    """
    images = seen(pairs, indices, "whole")
    places = range(0, images.shape[2] - patch_px + 1, stride_px)
    whole = network(images)[:, 0]
    falls = []
    for y, x in itertools.product(places, places):
        hidden = images.clone(memory_format=torch.preserve_format)
        hidden[:, :, y : y + patch_px, x : x + patch_px] = 0.0
        falls.append(whole - network(hidden)[:, 0])
    of_window = torch.stack(falls, 1).view(-1, 2, len(places), len(places)).double().numpy()
    truth: NDArray[np.float64] = of_window * np.array([-1.0, 1.0])[:, None, None]
    return truth
