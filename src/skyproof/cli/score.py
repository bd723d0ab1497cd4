"""`skyproof score`: detectors judged, with and without camouflages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.cli.rendering import Rendering
from skyproof.errors import ConfigurationError

__all__ = ["Score"]


@dataclass(frozen=True)
class Score(Rendering):
    """Judges detectors: with and without camouflages, and on annotated images.

    Camouflage folders are rendered here, onto the vehicles and scenes of --original, and their
    images are not kept. Datasets that are rendered already are given with --camouflaged. With
    --frames alone it is only checked how good the detectors are. A score folder inside the
    `scores` folder of a run is taken into the run's report.

    Attributes:
        detectors: detector folders.
        out: score folder to write, such as `my_run/scores/mine`.
        original: dataset without camouflage; its scenes are the ones that are judged.
        camouflages: camouflage folders; a folder's name is the camouflage's in the tables.
        camouflaged: NAME=FOLDER for datasets of the same scenes with a camouflage, such as
            T-U=data/test-T-U. A camouflage T-x is compared with its random controls R-x-0,
            R-x-1, ...
        backgrounds: background set folder of the scenes; needed for --camouflages.
        fleet: fleet folder of the scenes' vehicles; needed for --camouflages.
        frames: annotated images to check the detectors on, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD,
            such as 'kit/MOS*@0.116'; rendered datasets and tiled folders, too. Arguments of one
            NAME are one set of several places.
        frame_classes: class names that count as vehicles in the frames; other classes are
            ignored, not counted as mistakes.
        seed: of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    out: Path
    original: Path | None = None
    camouflages: tuple[Path, ...] = ()
    camouflaged: tuple[str, ...] = ()
    backgrounds: Path | None = None
    fleet: Path | None = None
    frames: tuple[str, ...] = ()
    frame_classes: tuple[str, ...] = ("car", "minibus")
    seed: int = 0
    device: str = "auto"

    def run(self) -> None:
        """Judges, and prints the rates of the mean and the checks."""
        from skyproof.cli.device import choose_device
        from skyproof.cli.frames import read_frames
        from skyproof.cli.stages import evaluate_folders, score_camouflages
        from skyproof.detectors.card import read_card

        self._refuse_what_cannot_work()
        device = choose_device(self.device)
        clean = read_frames(self.frames, self.frame_classes, read_card(self.detectors[0]).gsd_m)
        if self.original and self.camouflages and self.backgrounds and self.fleet:
            score_camouflages(
                self.detectors,
                self.camouflages,
                self.original / "scenes.jsonl",
                self.backgrounds,
                self.fleet,
                self.original,
                self.out,
                clean=clean,
                rendering=self,
                seed=self.seed,
                device=device,
            )
        elif self.original:
            pairs = {name: Path(place) for name, place in map(_named, self.camouflaged)}
            evaluate_folders(
                self.detectors, self.original, pairs, self.out,
                clean=clean, seed=self.seed, device=device,
            )  # fmt: skip
        say(f"Scores: {self.out.resolve()}")

    def _refuse_what_cannot_work(self) -> None:
        """Shows a mistake in the options before anything is rendered.

        Raises:
            ConfigurationError: nothing to judge, or something that belongs to it is missing.
        """
        worn = bool(self.camouflages or self.camouflaged)
        if not self.detectors or not (worn or self.frames):
            raise ConfigurationError(
                "Scoring expects --detectors and something to judge them on: --original with "
                "--camouflages or --camouflaged, or --frames."
            )
        if worn != (self.original is not None):
            raise ConfigurationError(
                "Scoring compares --original, a dataset without camouflage, with --camouflages "
                "or --camouflaged; give both sides."
            )
        if self.camouflages and (self.backgrounds is None or self.fleet is None):
            raise ConfigurationError(
                "--camouflages are rendered on --backgrounds and --fleet, those of the scenes of "
                "--original; give both."
            )


def _named(text: str) -> tuple[str, str]:
    name, _, place = text.partition("=")
    if not name or not place:
        raise ConfigurationError(f"--camouflaged expects NAME=FOLDER, got {text!r}.")
    return name, place
