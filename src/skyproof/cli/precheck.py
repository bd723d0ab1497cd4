"""`skyproof precheck`: tests of detectors before any attack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from msgspec import Meta
from tyro.conf import Suppress

from skyproof.cli.render import sampled_scenes
from skyproof.console import progress_bar, say
from skyproof.detectors.card import detector_folder, read_card
from skyproof.device import choose_device
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.ranges import Count, Seed
from skyproof.scenes.scene import read_scenes
from skyproof.scenes.settings import SceneSettings

if TYPE_CHECKING:
    import torch

    from skyproof.detectors.detector import Detector
    from skyproof.measure.precheck import PrecheckScenes
    from skyproof.results.precheck import MeasuredOn, PrecheckRecord


@dataclass(frozen=True)
class Precheck:
    """Checks detectors before any attack: baseline, plain paints, blur, random controls and sun.

    It changes one thing at a time in the same scenes. A detector that misses vehicles in a plain
    paint fails, because an attack says nothing about it. The result is precheck.json in every
    detector folder, and every report shows it. With `--freeze` the command instead writes a copy of
    a detector with its threshold frozen on `--frames`.

    Attributes:
        detectors: detector folders.
        backgrounds: background set folder.
        fleet: fleet folder.
        scenes: scene file on these backgrounds and vehicles; None draws scenes on the test split.
        scenes_count: number of scenes; more scenes take longer and narrow the intervals.
        image_px: side of drawn scenes in pixels; None is the first detector's training size.
        draws: number of draws of each random control.
        frames: annotated photographs, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...], as in
            `score`.
        frame_classes: vehicle classes of frames that name none.
        freeze: detector folder to write, a copy with another threshold.
        seed: seed of scenes, random controls and the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR ...")]
    backgrounds: Path | None = None
    fleet: Path | None = None
    scenes: Suppress[Path | None] = None
    scenes_count: Count = 60
    image_px: Suppress[Annotated[int, Meta(ge=96, le=16_384)] | None] = None
    draws: Suppress[Annotated[int, Meta(ge=1, le=100)]] = 5
    frames: tuple[str, ...] = ()
    frame_classes: Suppress[tuple[str, ...]] = ("car", "minibus")
    freeze: Path | None = None
    seed: Seed = 0
    device: str = "auto"

    def run(self, loaded: Sequence[Detector] = ()) -> None:
        """Checks the detectors (`loaded` already or not), stores the results and prints them."""
        if not self.detectors:
            raise ConfigurationError("A precheck expects at least one detector folder, got none.")
        if self.freeze is not None:
            self._freeze(self.freeze)
            return
        if self.backgrounds is None or self.fleet is None:
            raise ConfigurationError(
                "A precheck renders scenes: give --backgrounds and --fleet of the test split."
            )
        from skyproof.measure.baseline import read_frames
        from skyproof.measure.precheck import PrecheckScenes, precheck_lines
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.vehicles.fleet import Fleet

        for folder in self.detectors:
            if detector_folder(folder).parent not in (folder, folder.parent):
                what = f"{folder} comes with skyproof, and a precheck is stored beside its detector"
                raise ConfigurationError(f"{what}; give a detector folder of yours.")
        device = choose_device(self.device)
        backgrounds = BackgroundSet.open(self.backgrounds)
        fleet = Fleet.load(self.fleet)
        if self.scenes is not None:
            scenes = read_scenes(self.scenes)[: self.scenes_count]
        else:
            size_px = self.image_px or min(read_card(self.detectors[0]).image_size_px)
            usual, count, seed = SceneSettings(size_px=size_px), self.scenes_count, self.seed
            scenes = sampled_scenes(usual, backgrounds, fleet, "test", count, seed, name="check")
        frames = read_frames(self.frames, self.frame_classes, backgrounds.gsd_m)
        data = PrecheckScenes(backgrounds, fleet, scenes, self.draws, frames, self.seed)
        records = self._checked(data, device, loaded)
        for folder in self.detectors:
            for line in precheck_lines(records[folder], read_card(folder).doubts):
                say(line)

    def _checked(
        self, data: PrecheckScenes, device: torch.device, loaded: Sequence[Detector]
    ) -> dict[Path, PrecheckRecord]:
        """The records of all detectors by their folders, stored or new."""
        from skyproof.detectors.loaded import load_ensemble
        from skyproof.measure.precheck import precheck
        from skyproof.results.precheck import PRECHECK_FILE, write_precheck

        records = {
            folder: _known(folder, data.measured_on)
            for folder in self.detectors
            if (folder / PRECHECK_FILE).exists()
        }
        open_ones = [folder for folder in self.detectors if folder not in records]
        if open_ones:
            given = zip(self.detectors, loaded, strict=False)
            detectors = [detector for folder, detector in given if folder in open_ones]
            gsd_m = data.backgrounds.gsd_m
            detectors = detectors or [*load_ensemble(open_ones, device, gsd_m, apart=True)]
            with progress_bar("precheck") as update:
                made = precheck(detectors, data, device=device, progress=update)
            for folder, record in zip(open_ones, made, strict=True):
                write_precheck(folder, record)
                records[folder] = record
        return records

    def _freeze(self, out: Path) -> None:
        """Writes a copy of a detector with another frozen threshold."""
        if len(self.detectors) != 1 or not self.frames:
            raise ConfigurationError(
                "--freeze expects one detector folder, and labelled images to choose the threshold "
                "on; give --frames."
            )
        from skyproof.detectors.loaded import copy_with_threshold
        from skyproof.measure.baseline import read_frames

        (folder,) = self.detectors
        frames = read_frames(self.frames, self.frame_classes, read_card(folder).gsd_m)
        labelled = {each.name: each.images for each in frames}
        told = copy_with_threshold(folder, labelled, out, choose_device(self.device))
        say(f"{told} Detector: {out.resolve()}")
        for doubt in read_card(out).doubts:
            say(f"Warning: {doubt}")


def _known(folder: Path, wanted: MeasuredOn) -> PrecheckRecord:
    """Returns a detector's stored record; refuses one of other weights, scenes or images."""
    from skyproof.results.precheck import PRECHECK_FILE, read_precheck

    record = read_precheck(folder)
    card = read_card(folder)
    differing = wanted.differing(record.measured_on)
    if (record.weights_sha256, record.threshold) != (card.weights_sha256, card.threshold):
        differing = ["weights or threshold"]
    if differing:
        raise RunFolderError(
            f"{folder / PRECHECK_FILE} belongs to other {', '.join(differing)} and is not "
            "overwritten; move it away to precheck the detector again."
        )
    return record
