"""The single stages around an attack as commands: scenes, render, train, evaluate, report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from skyproof.cli.console import say
from skyproof.cli.frames import read_frames
from skyproof.cli.rendering import Rendering
from skyproof.cli.stages import (
    choose_device,
    evaluate_folders,
    generator_of,
    render_folder,
    train_detector,
)
from skyproof.detectors.card import read_card
from skyproof.detectors.settings import TRAINING_PRESETS
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing
from skyproof.report.report import write_report
from skyproof.report.words import interval, percent
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet

__all__ = ["Evaluate", "Render", "Report", "Scenes", "Train"]


@dataclass(frozen=True)
class Scenes:
    """Samples scenes on a split's ground, in any weather: which window, camera, sun, vehicles where.

    Attributes:
        backgrounds: background set folder.
        fleet: fleet folder.
        out: scene file (JSON lines) to write.
        split: of the backgrounds: train, validation, attack or test.
        count: how many scenes.
        image_px: image side.
        vehicles_minimum, vehicles_maximum: per image.
        conditions: weather and light, each equally likely: clear, haze, rain, low_sun, overcast, exposure, noise, jpeg.
        parked_share: share of the scenes whose vehicles stand in a row, as parked ones do.
        seed: of everything.
    """

    backgrounds: Path
    fleet: Path
    out: Path
    split: Literal["train", "validation", "attack", "test"] = "test"
    count: int = 120
    image_px: int = 192
    vehicles_minimum: int = 1
    vehicles_maximum: int = 5
    conditions: tuple[str, ...] = ("clear",)
    parked_share: float = 0.0
    seed: int = 0

    def run(self) -> None:
        """Samples and writes."""
        if self.count < 1:
            raise ConfigurationError(f"--count expects at least 1 scene, got {self.count}.")
        refuse_existing(self.out)
        backgrounds, fleet = BackgroundSet.open(self.backgrounds), Fleet.load(self.fleet)
        settings = SceneSettings(
            size_px=self.image_px,
            gsd_m=backgrounds.gsd_m,
            vehicles_minimum=self.vehicles_minimum,
            vehicles_maximum=self.vehicles_maximum,
            conditions=self.conditions,
            parked_share=self.parked_share,
        )
        generator = generator_of(self.seed, "scenes", self.split)
        scenes = sample_scenes(
            settings,
            backgrounds,
            self.split,
            fleet.sizes_m,
            self.count,
            generator=generator,
            prefix=self.split,
        )
        write_scenes(self.out, scenes)
        say(f"Scenes: {self.out.resolve()}")


@dataclass(frozen=True)
class Render(Rendering):
    """Draws a scene file to images with COCO labels, with or without a camouflage.

    With --renderer cycles the same scenes are path-traced in Blender, to the same labels.

    Attributes:
        scenes: scene file (JSON lines).
        backgrounds: background set folder.
        fleet: fleet folder.
        out: dataset folder to write.
        camouflage: camouflage folder; none draws the vehicles as they are.
        device: auto, cpu or cuda.
    """

    scenes: Path
    backgrounds: Path
    fleet: Path
    out: Path
    camouflage: Path | None = None
    device: str = "auto"

    def run(self) -> None:
        """Draws the dataset."""
        device = choose_device(self.device)
        render_folder(
            self.scenes,
            self.backgrounds,
            self.fleet,
            self.out,
            camouflage=self.camouflage,
            rendering=self,
            device=device,
        )
        say(f"Dataset: {self.out.resolve()}")


@dataclass(frozen=True)
class Train:
    """Trains a detector on a dataset folder and freezes its threshold; goes on where it was stopped.

    Attributes:
        detector: retinanet, faster_rcnn or yolov5.
        data: dataset folder to train on.
        validation: dataset folder that chooses the best weights and the threshold.
        out: detector folder to write.
        size: slim (for a CPU) or full (for a GPU).
        steps: optimiser steps; the preset's where not given.
        batch_size: images a step; the preset's where not given.
        learning_rate: its peak; the preset's where not given.
        seed: of weights, order and augmentation.
        device: auto, cpu or cuda.
    """

    detector: str
    data: Path
    validation: Path
    out: Path
    size: str = "slim"
    steps: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    seed: int = 0
    device: str = "auto"

    def run(self) -> None:
        """Trains the detector."""
        if (self.detector, self.size) not in TRAINING_PRESETS:
            known = ", ".join(sorted({name for name, _ in TRAINING_PRESETS}))
            raise ConfigurationError(
                f"expected a detector out of {known} in size slim or full, got {self.detector} {self.size}."
            )
        given = {
            "steps": self.steps,
            "batch_size": self.batch_size,
            "learning_rate": self.learning_rate,
        }
        preset = TRAINING_PRESETS[self.detector, self.size]
        settings = type(preset)(
            **{**vars(preset), **{k: v for k, v in given.items() if v is not None}}
        )
        device = choose_device(self.device)
        train_detector(
            self.detector,
            self.size,
            self.data,
            self.validation,
            settings,
            self.out,
            seed=self.seed,
            device=device,
        )
        card = read_card(self.out)
        say(
            f"Validation AP (centre within 1 m) {card.validation['ap_centre_1m']:.3f}, threshold {card.threshold:.3f}. "
            f"Detector: {self.out.resolve()}"
        )


@dataclass(frozen=True)
class Evaluate:
    """Compares datasets of the same scenes with and without camouflage: success rates with intervals.

    Attributes:
        detectors: detector folders.
        original: dataset without camouflage.
        camouflaged: NAME=FOLDER for each camouflaged dataset, e.g. T-U=data/test-T-U R-U-0=data/test-R-U-0. A
            camouflage T-x is compared with its random controls R-x-0, R-x-1, ...
        out: folder to write.
        frames: real annotated frames to check the detectors on, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD (COCO, YOLO or
            DOTA labels).
        frame_classes: class names that count as vehicles in them.
        seed: of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    original: Path
    camouflaged: tuple[str, ...]
    out: Path
    frames: tuple[str, ...] = ()
    frame_classes: tuple[str, ...] = ("car", "minibus")
    seed: int = 0
    device: str = "auto"

    def run(self) -> None:
        """Compares, and prints the rows of the table."""
        pairs = {}
        for text in self.camouflaged:
            name, _, place = text.partition("=")
            if not name or not place:
                raise ConfigurationError(f"--camouflaged expects NAME=FOLDER, got {text!r}.")
            if name in pairs:
                raise ConfigurationError(
                    f"--camouflaged names {name} twice; give each camouflage once."
                )
            pairs[name] = Path(place)
        if not pairs or not self.detectors:
            raise ConfigurationError(
                "Evaluation expects at least one detector and one camouflaged dataset."
            )
        gsd_m = read_card(self.detectors[0]).gsd_m
        clean = read_frames(self.frames, self.frame_classes, gsd_m)
        rows = evaluate_folders(
            self.detectors,
            self.original,
            pairs,
            self.out,
            clean=clean,
            seed=self.seed,
            device=choose_device(self.device),
        )
        for row in rows:
            if row["match"] == "centre_1m":
                say(
                    f"  {row['camouflage']:<8} {row['detector']:<12} EASR {percent(row['easr'])} "
                    f"({interval(row['easr_low'], row['easr_high'])})"
                )
        say(f"Results: {(self.out / 'results.json').resolve()}")


@dataclass(frozen=True)
class Report:
    """Writes report.html from a run folder's files.

    Attributes:
        run_folder: as the demo leaves it.
    """

    run_folder: Path

    def run(self) -> None:
        """Writes the report."""
        say(f"Report: {write_report(self.run_folder).resolve()}")
