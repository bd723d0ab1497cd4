"""The single stages around an attack as commands: evaluate, report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cli.frames import read_frames
from skyproof.cli.stages import evaluate_folders
from skyproof.detectors.card import read_card
from skyproof.errors import ConfigurationError
from skyproof.report.report import write_report
from skyproof.words import interval, percent

__all__ = ["Evaluate", "Report"]


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
