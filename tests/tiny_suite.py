"""A suite that is far too small, for tests of whole runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch

from skyproof.assessment.suite import DEMO_SUITE, Suite, read_suite
from skyproof.layout import Layout
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from skyproof.vehicles.fleet import Fleet

_WHOLE = read_suite(DEMO_SUITE)
TINY_SUITE = replace(
    _WHOLE,
    settings=replace(_WHOLE.settings, batch_size=2, balance_batches=1, checkpoint_every=2),
    steps=replace(_WHOLE.steps, texture=4),
    draws=2,
    searches=1,
    attack_m=16.0,
    image_m=16.0,
    test_images=6,
    empty_images=6,
    tiles=(1, 1, 2, 3),
    vehicles=(1, 1, 2, 3),
)
"""The demo's attacks: two textures and six controls that detectors choose."""


@contextmanager
def tiny_suite(suite: Suite = TINY_SUITE) -> Iterator[None]:
    """Within it, runs go by this suite."""

    def read(path: Path = DEMO_SUITE) -> Suite:
        return suite

    with patch("skyproof.assessment.assess.read_suite", read):
        yield


def draw_datasets(run_folder: Path, size_px: int, train: int, validation: int) -> None:
    """Adds images to train on to a run, which has none: on its ground, with its vehicles."""
    layout = Layout(run_folder)
    backgrounds = BackgroundSet.open(layout.backgrounds)
    splits: dict[Split, int] = {"train": train, "validation": validation}
    for split, count in splits.items():
        fleet = Fleet.load(layout.fleets / split)
        scenes = sample_scenes(
            SceneSettings(size_px=size_px, vehicles_maximum=3),
            backgrounds,
            split,
            fleet.sizes_m,
            count,
            generator=torch.Generator().manual_seed(count),
            prefix=split,
        )
        render_dataset(layout.dataset(split), scenes, fleet, TorchRenderer(backgrounds))
