"""Times a training step of every wide detector beside the same step of its slim version.

python tools/bench_training.py

One thread, 8 images of 192 px with random boxes; both sizes take turns within one run, and medians
are printed with their ratio.
"""

from __future__ import annotations

import statistics
import time

import torch

from skyproof.detectors.build import DETECTOR_NAMES, build_detector
from skyproof.detectors.detector import TrainableDetector

_SIZES = ("slim", "wide")
_TURNS = 15
_IMAGES = 8
_SIDE_PX = 192


def main() -> None:
    """Prints one row of a table per detector."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(_IMAGES, 3, _SIDE_PX, _SIDE_PX, generator=generator)
    images = images.contiguous(memory_format=torch.channels_last)
    corners = torch.rand(_IMAGES, 3, 2, generator=generator) * (_SIDE_PX - 40)
    boxes = list(torch.cat([corners, corners + torch.tensor([36.0, 15.0])], dim=2))
    for name in DETECTOR_NAMES:
        networks = {size: build_detector(name, size, generator=generator) for size in _SIZES}
        optimisers = {
            size: torch.optim.AdamW(network.parameters(), lr=1e-4)
            for size, network in networks.items()
        }
        times_s: dict[str, list[float]] = {size: [] for size in _SIZES}
        for network in networks.values():
            network.train().to(memory_format=torch.channels_last)
        for turn in range(_TURNS + 1):
            for size in _SIZES:
                started = time.process_time()
                _step(networks[size], optimisers[size], images, boxes)
                # The first turn warms up.
                if turn:
                    times_s[size].append(time.process_time() - started)
        slim_s, wide_s = (statistics.median(times_s[size]) for size in _SIZES)
        ratio = statistics.median(wide / slim for slim, wide in zip(*times_s.values(), strict=True))
        print(f"| {name} | {slim_s:.3f} | {wide_s:.3f} | {ratio:.2f} |")


def _step(
    network: TrainableDetector,
    optimiser: torch.optim.Optimizer,
    images: torch.Tensor,
    boxes: list[torch.Tensor],
) -> None:
    optimiser.zero_grad(set_to_none=True)
    network.loss(images, boxes).mean().backward()
    optimiser.step()


if __name__ == "__main__":
    main()
