"""The single stages around an attack as commands: train, evaluate, report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cli.frames import read_frames
from skyproof.cli.stages import evaluate_folders, train_detector
from skyproof.detectors.card import read_card
from skyproof.detectors.settings import TRAINING_PRESETS
from skyproof.errors import ConfigurationError
from skyproof.report.report import write_report
from skyproof.words import interval, percent

__all__ = ["Evaluate", "Report", "Train"]


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
