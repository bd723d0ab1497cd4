"""Trains the network of `adversarial.py` against a discriminator, on maps of fitted vehicles."""

import copy
import hashlib
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from skyproof.generator.adversarial import LATENT, PARTS, AdversarialGenerator, Network
from skyproof.generator.fits import FittedVehicles
from skyproof.generator.maps import MAP_PX, half_grid, whole
from skyproof.generator.settings import AdversarialSettings
from skyproof.loop import Loop
from skyproof.randomness import generator_of

_EMA = 0.998
_CHECKPOINT_EVERY = 100
_LEAST_SPREAD_M = 0.01
# Fitted and made maps are both shifted along the vehicle by at most this many texels: otherwise the
# discriminator would memorise the few hundred vehicles.
_JITTER = 2


class _Discriminator(nn.Module):
    """Tells made maps from fitted ones, patch by patch; it sees whole maps, circular in u."""

    def __init__(self) -> None:
        super().__init__()
        channels = [3 + PARTS + 3 + 1 + 2, 48, 96, 128]
        self.layers = nn.ModuleList(
            spectral_norm(nn.Conv2d(before, after, 4, stride=2))
            for before, after in pairwise(channels)
        )
        self.last = spectral_norm(nn.Conv2d(channels[-1], 1, 3))

    def forward(self, maps: Float[Tensor, "N C 64 64"]) -> Tensor:
        for layer in self.layers:
            maps = F.leaky_relu(layer(_closed(maps)), 0.2)
        return self.last(_closed(maps))


def _closed(maps: Tensor) -> Tensor:
    """Pads whole maps, circularly in u; values at nose and tail are repeated."""
    around = torch.cat((maps[..., -1:], maps, maps[..., :1]), dim=-1)
    return F.pad(around, (0, 0, 1, 1), mode="replicate")


def _judged(maps: Tensor, seen: Tensor, shift: int) -> Tensor:
    """Returns half maps as the discriminator sees them: unseen texels have no colour."""
    maps = whole(torch.cat((maps[:, :3] * seen, maps[:, 3:], seen), dim=1))
    if shift:
        maps = F.pad(maps, (0, 0, _JITTER, _JITTER), mode="replicate")
        maps = maps[:, :, _JITTER + shift : _JITTER + shift + MAP_PX]
    along = torch.linspace(-1, 1, MAP_PX)[:, None].expand(MAP_PX, MAP_PX)
    around = torch.cos(torch.linspace(0, 2 * torch.pi, MAP_PX + 1)[:-1]).expand(MAP_PX, MAP_PX)
    places = torch.stack((along, around)).expand(len(maps), 2, MAP_PX, MAP_PX)
    return torch.cat((maps, places.to(maps.device)), dim=1)


def learn_adversarially(
    vehicles: FittedVehicles,
    settings: AdversarialSettings,
    folder: Path,
    seed: int = 0,
    device: torch.device | str = "cpu",
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> AdversarialGenerator:
    """Trains the network; a stopped training goes on from its last checkpoint.

    `folder` gets `steps.jsonl` and checkpoints, `on_step` each row of `steps.jsonl`.
    """
    grids = half_grid(vehicles.vertices)
    mean = grids.mean(0, keepdim=True)
    spread = grids.std(0, correction=0, keepdim=True).clamp(min=_LEAST_SPREAD_M)
    moved = F.interpolate(
        (grids - mean) / spread, size=(MAP_PX, MAP_PX // 2), mode="bilinear", align_corners=True
    )
    # Texels seen a little count almost fully, because `seen` measures light, not what is known.
    seen = (vehicles.seen / 0.1).clamp(max=1.0)[:, None].to(device)
    real = torch.cat((vehicles.albedo, vehicles.parts, moved), dim=1).to(device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**62, (), generator=generator_of(seed, "gan"))))
        network, judge = Network(mean, spread).to(device), _Discriminator().to(device)
    average = copy.deepcopy(network)
    rate = settings.learning_rate
    optimisers = (
        torch.optim.Adam(network.parameters(), lr=rate, betas=(0.0, 0.9)),
        torch.optim.Adam(judge.parameters(), lr=4 * rate, betas=(0.0, 0.9)),
    )
    loop = Loop(
        folder,
        {"settings": asdict(settings), "seed": seed, "vehicles": _digest(vehicles)},
        settings.steps,
        _CHECKPOINT_EVERY,
        {
            "network": network,
            "judge": judge,
            "average": average,
            "optimiser": optimisers[0],
            "judge_optimiser": optimisers[1],
        },
        other="a generator of other vehicles, or with other settings",
        remedy=f"remove {folder} and learn again",
        on_row=on_step,
    )
    loop.resume()
    for step in loop:
        generator = generator_of(seed, "step", step)
        losses = _step(network, judge, optimisers, (real, seen), settings.batch_size, generator)
        with torch.no_grad():
            for kept, current in zip(average.parameters(), network.parameters(), strict=True):
                kept.lerp_(current, 1 - _EMA)
        loop.report({"step": step, **losses})
    return AdversarialGenerator(average.cpu())


def _digest(vehicles: FittedVehicles) -> str:
    numbers = torch.cat([vehicles.albedo.flatten(), vehicles.vertices.flatten()])
    return hashlib.sha256(numbers.numpy().tobytes()).hexdigest()


def _step(
    network: Network,
    judge: _Discriminator,
    optimisers: tuple[torch.optim.Optimizer, torch.optim.Optimizer],
    real: tuple[Tensor, Tensor],
    count: int,
    generator: torch.Generator,
) -> dict[str, float]:
    """One step of the discriminator, and one of the generator; hinge losses."""
    fitted, seen = real

    def draw() -> Tensor:
        return torch.randint(len(fitted), (count,), generator=generator)

    def shift() -> int:
        return int(torch.randint(-_JITTER, _JITTER + 1, (), generator=generator))

    def made() -> Tensor:
        latent = torch.randn(count, LATENT, generator=generator)
        return torch.cat(network(latent.to(fitted.device)), dim=1)

    rows = draw()
    others = draw()
    with torch.no_grad():
        fakes = made()
    on_real = judge(_judged(fitted[rows], seen[rows], shift()))
    on_fake = judge(_judged(fakes, seen[others], shift()))
    judge_loss = F.relu(1 - on_real).mean() + F.relu(1 + on_fake).mean()
    optimisers[1].zero_grad()
    judge_loss.backward()
    optimisers[1].step()

    loss = -judge(_judged(made(), seen[draw()], shift())).mean()
    optimisers[0].zero_grad()
    loss.backward()
    optimisers[0].step()
    return {"loss": float(loss.detach()), "judge_loss": float(judge_loss.detach())}
