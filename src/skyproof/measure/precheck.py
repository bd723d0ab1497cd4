"""Runs the gate: every trial drawn once, in memory, and looked at by all detectors."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from skyproof.camouflage.palette import ground_palette
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.inference import detect_all, detect_by_each
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.detectors.weights import weights_digest
from skyproof.errors import ConfigurationError
from skyproof.measure.baseline import BaselineSet, measure_baseline
from skyproof.measure.trials import Trial, make_trials
from skyproof.render.dataset import in_threads, placed_vehicles
from skyproof.render.frames import Frames
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.results.baseline import Baseline
from skyproof.results.pairs.compare import Comparison, compare
from skyproof.results.pairs.tiles import count_cells
from skyproof.results.precheck import Kind, MeasuredOn, PrecheckRecord, Rate
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.sample import Sample
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, scenes_digest
from skyproof.seeds import numpy_generator
from skyproof.vehicles.fleet import Fleet

Judge = LoadedDetector[Detector]

_BATCH_SIZE = 8
_RENDERED = "rendered scenes"


def precheck(
    judges: Sequence[Judge],
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
    """Tells of every detector, before any attack, whether it is worth attacking.

    The scenes are drawn as they are, then once more for each trial: 27 plain paints on body panels
    and 27 on the whole vehicle, eight two-tone paints, four sharpnesses, six random controls, four
    suns. Counted is what each change hides of the vehicles found before, by centres within 1 m at
    the frozen threshold, as for any camouflage. Nothing is written.

    Args:
        judges: detectors with their cards.
        backgrounds: the ground of the scenes; the fixed colours of Fc come from its attack split.
        fleet: the scenes' vehicles.
        scenes: what is drawn, of one image size and of the detectors' resolution.
        draws: of every random control.
        frames: annotated photographs to check the detectors on.
        seed: of random controls and of the bootstrap.
        device: where pictures are drawn.
        progress: called with (images done, images in all).

    Returns:
        Per detector what was measured; `skyproof.results.findings` judges it.

    Raises:
        ConfigurationError: no scenes, scenes without vehicles, frames without labels, a detector
            of another resolution than the scenes', or one that finds nothing.
        StoredFileError: a tile or a frame is missing or damaged.
    """
    _refuse_what_cannot_work(judges, scenes, frames)
    trials = make_trials(ground_palette(backgrounds), draws=draws, seed=seed)
    images = len(scenes) * (1 + len(trials))
    gate = _Gate(judges, backgrounds, fleet, scenes, seed, torch.device(device), images, progress)
    unchanged = gate.see(Trial("sun", "unchanged"))
    sets = [gate.check_scenes(judge, unchanged) for judge in judges]
    for judge, check in zip(judges, sets, strict=True):
        if not check.recall.estimate > 0:
            raise ConfigurationError(
                f"{judge.name} finds none of the {check.vehicles} vehicles of these scenes at its "
                f"threshold of {judge.threshold:.4g}, so nothing can be hidden from it; train it "
                "longer or on more images."
            )
    photographs = [[gate.check_frames(judge, each) for each in frames] for judge in judges]
    rates = gate.rates(unchanged, trials)
    on = measured_on(backgrounds, fleet, scenes, draws=draws, seed=seed, frames=frames)
    return [
        PrecheckRecord(
            judge.name,
            _digest(judge.detector),
            judge.threshold,
            on,
            [check, *of_frames],
            rates[judge.name],
        )
        for judge, check, of_frames in zip(judges, sets, photographs, strict=True)
    ]


def measured_on(
    backgrounds: BackgroundSet,
    fleet: Fleet,
    scenes: Sequence[Scene],
    *,
    draws: int,
    seed: int,
    frames: Sequence[BaselineSet] = (),
) -> MeasuredOn:
    """Says what a check measures on; two checks that agree in it measured the same."""
    names = dict.fromkeys(scene.background.tile for scene in scenes)
    tiles = [backgrounds.tile(name) for name in names]
    return MeasuredOn(
        scenes=len(scenes),
        scenes_sha256=scenes_digest(scenes),
        sources=tuple(dict.fromkeys(tile.source for tile in tiles)),
        draws=draws,
        seed=seed,
        frames=tuple(each.name for each in frames),
        frames_sha256=tuple(_told(each.images.digest, each.note) for each in frames),
        ground_sha256=_told(backgrounds.gsd_m, tiles),
        fleet_sha256=_told(fleet.sizes_m),
    )


def _told(*values: Any) -> str:
    return hashlib.sha256(msgspec.json.encode(values)).hexdigest()


def _refuse_what_cannot_work(
    judges: Sequence[Judge], scenes: Sequence[Scene], frames: Sequence[BaselineSet]
) -> None:
    if not judges:
        raise ConfigurationError("A check expects at least one detector; give detector folders.")
    if not scenes or not any(scene.placements for scene in scenes):
        raise ConfigurationError(
            f"A check expects scenes with vehicles, got {len(scenes)} scenes without any; sample "
            "others."
        )
    names = [judge.name for judge in judges]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigurationError(
            f"Two detectors are called {twice!r}; give each once, or check them separately."
        )
    gsd_m = scenes[0].camera.gsd_m
    for judge in judges:
        if not math.isclose(judge.card.gsd_m, gsd_m):
            raise ConfigurationError(
                f"{judge.name} was trained at {judge.card.gsd_m} m per pixel but the scenes have "
                f"{gsd_m} m; give a detector and ground of one resolution."
            )
    for each in frames:
        if not sum(map(len, each.images.boxes)):
            raise ConfigurationError(
                f"{each.name} has no labelled vehicles, so nothing says what a detector misses "
                "there; give frames with labels, or leave them out."
            )


@dataclass(frozen=True)
class _Seen:
    """One trial's pictures as all detectors see them.

    Attributes:
        labelled: the pictures with their vehicles.
        found: by detector, per picture its detections.
    """

    labelled: Dataset
    found: dict[str, list[Detections]]

    def matched(self, judge: Judge) -> MatchTable:
        return match_images(self.found[judge.name], self.labelled, criterion="centre_1m")


@dataclass
class _Gate:
    """The same scenes, drawn again and again."""

    judges: Sequence[Judge]
    backgrounds: BackgroundSet
    fleet: Fleet
    scenes: Sequence[Scene]
    seed: int
    device: torch.device
    images: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def see(self, trial: Trial) -> _Seen:
        """Draws the scenes under a trial, and has every detector look at them."""
        scenes = [_lit(scene, trial.sun_elevation_deg) for scene in self.scenes]
        batches = [
            scenes[start : start + _BATCH_SIZE] for start in range(0, len(scenes), _BATCH_SIZE)
        ]
        renderer = self._renderer
        if trial.blur_sigma_px is not None:
            settings = RenderSettings(blur_sigma_px=trial.blur_sigma_px)
            renderer = TorchRenderer(self.backgrounds, settings)
        camouflage = None if trial.camouflage is None else trial.camouflage.to(self.device)

        @torch.no_grad()
        def draw(batch: Sequence[Scene]) -> Frames:
            vehicles = placed_vehicles(self.fleet, batch).to(self.device)
            return renderer(batch, camouflage(vehicles) if camouflage else vehicles)

        images: list[UInt8[Tensor, "3 H W"]] = []
        boxes: list[Tensor] = []
        found: dict[str, list[Detections]] = {judge.name: [] for judge in self.judges}
        threads = torch.get_num_threads()
        with in_threads(draw, batches, threads if self.device.type == "cpu" else 1) as drawn:
            # Drawing is done ahead, so most of the time the detectors have the cores to themselves.
            torch.set_num_threads(threads)
            for batch, frames in zip(batches, drawn, strict=True):
                pixels = (frames.image * 255).round().byte()
                # As photographs are looked at, in windows where they are large.
                nothing = [torch.zeros(0, 4)] * len(pixels)
                shown = Dataset.of_images(list(pixels), nothing, gsd_m=scenes[0].camera.gsd_m)
                looked = detect_by_each([judge.detector for judge in self.judges], shown)
                for judge, answers in zip(self.judges, looked, strict=True):
                    found[judge.name] += answers
                images += pixels.cpu()
                owner = frames.scene_index.cpu()
                boxes += [frames.boxes.cpu()[owner == index] for index in range(len(batch))]
                self.done += len(batch)
                if self.progress:
                    self.progress(self.done, self.images)
        gsd_m = scenes[0].camera.gsd_m
        names = [scene.id for scene in scenes]
        return _Seen(Dataset.of_images(images, boxes, gsd_m=gsd_m, ids=names), found)

    def rates(self, unchanged: _Seen, trials: Sequence[Trial]) -> dict[str, list[Rate]]:
        """What each change hides from each detector; draws of one control are averaged.

        These draws are taken as given: what others would do is left open.
        """
        cells = sorted(
            {
                (scene.background.tile, placement.vehicle)
                for scene in self.scenes
                for placement in scene.placements
            }
        )
        row_of = {cell: row for row, cell in enumerate(cells)}
        sample = Sample.draw(cells, generator=numpy_generator(self.seed))
        before = {judge.name: unchanged.matched(judge) for judge in self.judges}
        counts: dict[tuple[str, Kind, str], list[np.ndarray]] = {}
        for trial in trials:
            seen = self.see(trial)
            for judge in self.judges:
                outcomes = compare(
                    self.scenes,
                    before[judge.name],
                    seen.matched(judge),
                    Comparison(trial.name, TorchRenderer.name, judge.name, judge.threshold),
                )
                key = (judge.name, trial.kind, trial.name)
                counts.setdefault(key, []).append(count_cells(outcomes, row_of))
        rates: dict[str, list[Rate]] = {judge.name: [] for judge in self.judges}
        for (detector, kind, name), drawn in counts.items():
            easr = mean_interval(Group(np.stack(drawn)), sample)
            rates[detector].append(Rate(kind, name, len(drawn), easr))
        return rates

    def check_scenes(self, judge: Judge, unchanged: _Seen) -> Baseline:
        """How good a detector is on the scenes as they are."""
        note = "drawn as they are, before any change"
        clean = BaselineSet(
            _RENDERED, unchanged.labelled, real=False, note=note, places=self._places
        )
        return self._check(judge, clean, unchanged.found[judge.name])

    def check_frames(self, judge: Judge, frames: BaselineSet) -> Baseline:
        """How good a detector is on photographs."""
        return self._check(judge, frames, detect_all(judge.detector, frames.images))

    def _check(self, judge: Judge, clean: BaselineSet, found: Sequence[Detections]) -> Baseline:
        centre = match_images(found, clean.images, criterion="centre_1m")
        overlap = match_images(found, clean.images, criterion="iou_50")
        return measure_baseline(judge, clean, centre, overlap, generator=numpy_generator(self.seed))

    @cached_property
    def _renderer(self) -> TorchRenderer:
        """One for all trials, so that what they share is worked out once."""
        return TorchRenderer(self.backgrounds)

    @property
    def _places(self) -> list[str]:
        return [scene.background.tile for scene in self.scenes]


def _lit(scene: Scene, elevation_deg: float | None) -> Scene:
    if elevation_deg is None:
        return scene
    return replace(scene, sun=replace(scene.sun, elevation_rad=math.radians(elevation_deg)))


def _digest(detector: Detector) -> str:
    return weights_digest(detector) if isinstance(detector, nn.Module) else ""
