"""The precheck: is a detector worth attacking? Changes that no attack optimised answer that."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import msgspec
import numpy as np
import torch

from skyproof.camouflage.palette import ground_palette
from skyproof.detectors.detector import Detector
from skyproof.errors import ConfigurationError
from skyproof.measure.baseline import BaselineSet, measure_baseline, measure_baselines
from skyproof.measure.measure import compare
from skyproof.measure.trials import Trial, make_trials
from skyproof.measure.views import Stage, View, counter, views
from skyproof.render.renderer import TorchRenderer
from skyproof.results.pairs.counts import count_cells
from skyproof.results.precheck import Kind, MeasuredOn, PrecheckRecord, Rate
from skyproof.results.result import MAIN_MATCH
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.sample import Sample
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, scenes_digest
from skyproof.seeds import numpy_generator
from skyproof.vehicles.fleet import Fleet


def precheck(
    detectors: Sequence[Detector],
    backgrounds: BackgroundSet,
    fleet: Fleet,
    scenes: Sequence[Scene],
    *,
    draws: int = 5,
    frames: Sequence[BaselineSet] = (),
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> list[PrecheckRecord]:
    """Measures what plain changes hide from every detector, and how good it is without them.

    The scenes are drawn as they are, then once more for each trial: 27 plain paints on body panels
    and 27 on the whole vehicle, eight two-tone paints, four sharpnesses, six random controls, four
    suns. Rates are by centres within 1 m at the frozen threshold. Nothing is written.

    Args:
        detectors: with their cards.
        backgrounds: the ground of the scenes; the fixed colours of Fc come from its attack split.
        fleet: the scenes' vehicles.
        scenes: of one image size and of the detectors' resolution.
        draws: of every random control.
        frames: annotated photographs, whose baseline is measured, too.
        seed: of random controls and of the bootstrap.
        device: where pictures are drawn.
        progress: called with (images done, images in all).

    Returns:
        Per detector what was measured; `skyproof.results.findings` judges it.

    Raises:
        ConfigurationError: as `views` does, or frames without labels.
        StoredFileError: a tile or a frame is missing or damaged.
    """
    for each in frames:
        if not sum(map(len, each.images.boxes)):
            raise ConfigurationError(
                f"{each.name} has no labelled vehicles, so nothing says what a detector misses "
                "there; give frames with labels, or leave them out."
            )
    trials = make_trials(ground_palette(backgrounds), draws=draws, seed=seed)
    stage = Stage(fleet, TorchRenderer(backgrounds), device)
    count = counter(progress, len(scenes) * (1 + len(trials)))
    changes = [trial.change for trial in trials]
    seen = views(detectors, scenes, changes, stage, progress=count)
    before = next(seen)
    drawn = BaselineSet(
        "rendered scenes",
        before.images,
        real=False,
        note="drawn as they are, before any change",
        places=[scene.background.tile for scene in scenes],
    )
    baselines = [measure_baseline(each, drawn, before, seed=seed) for each in detectors]
    baselines += measure_baselines(detectors, frames, seed=seed)
    rates = _rates(detectors, scenes, trials, before, seen, seed)
    on = measured_on(backgrounds, fleet, scenes, draws=draws, seed=seed, frames=frames)
    return [
        PrecheckRecord(
            each.name,
            each.weights_sha256,
            each.threshold,
            on,
            [baseline for baseline in baselines if baseline.detector == each.name],
            rates[each.name],
        )
        for each in detectors
    ]


def _rates(
    detectors: Sequence[Detector],
    scenes: Sequence[Scene],
    trials: Sequence[Trial],
    before: View,
    changed: Iterable[View],
    seed: int,
) -> dict[str, list[Rate]]:
    """What each change hides from each detector; draws of one control are averaged.

    These draws are taken as given: what others would do is left open.
    """
    cells = sorted(
        {
            (scene.background.tile, placement.vehicle)
            for scene in scenes
            for placement in scene.placements
        }
    )
    row_of = {cell: row for row, cell in enumerate(cells)}
    sample = Sample.draw(cells, generator=numpy_generator(seed))
    counts: dict[tuple[str, Kind, str], list[np.ndarray]] = {}
    for trial, after in zip(trials, changed, strict=True):
        for each in detectors:
            outcomes = compare(scenes, before, after, each, TorchRenderer.name, [MAIN_MATCH])
            key = (each.name, trial.kind, trial.name)
            counts.setdefault(key, []).append(count_cells(outcomes, row_of))
    rates: dict[str, list[Rate]] = {each.name: [] for each in detectors}
    for (detector, kind, name), drawn in counts.items():
        easr = mean_interval(Group(np.stack(drawn), sample))
        rates[detector].append(Rate(kind, name, len(drawn), easr))
    return rates


def measured_on(
    backgrounds: BackgroundSet,
    fleet: Fleet,
    scenes: Sequence[Scene],
    *,
    draws: int,
    seed: int,
    frames: Sequence[BaselineSet] = (),
) -> MeasuredOn:
    """Says what a precheck measures on; two that agree in it measured the same."""
    names = dict.fromkeys(scene.background.tile for scene in scenes)
    tiles = [backgrounds.tile(name) for name in names]
    return MeasuredOn(
        scenes=len(scenes),
        scenes_sha256=scenes_digest(scenes),
        sources=tuple(dict.fromkeys(tile.source for tile in tiles)),
        draws=draws,
        seed=seed,
        frames=tuple(each.name for each in frames),
        frames_sha256=tuple(_digest(each.images.digest, each.note) for each in frames),
        ground_sha256=_digest(backgrounds.gsd_m, tiles),
        fleet_sha256=_digest(fleet.sizes_m),
    )


def _digest(*values: Any) -> str:
    return hashlib.sha256(msgspec.json.encode(values)).hexdigest()
