"""Vehicle-free backgrounds from real tiles as commands: clear a tiled folder, and drop what a person rejects."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from skyproof.cli.console import progress_bar, say
from skyproof.cli.device import choose_device
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.weights import weights_digest
from skyproof.files import finished_folder, refuse_existing
from skyproof.imagery.clearing.clear import ClearSettings, clear_backgrounds, drop_tiles
from skyproof.imagery.clearing.inpainting import Diffusion, Exemplar, Inpainting, LearntInpainting
from skyproof.imagery.clearing.vehicle_finder import VehicleFinder

__all__ = ["Clear", "Drop"]


@dataclass(frozen=True)
class Clear:
    """Removes the vehicles from tiled imagery, so that it can serve as backgrounds.

    Labelled vehicles and what a detector finds are masked with their shadows and filled with ground; a detector checks
    the result, and sheets/index.html shows a person what was done.

    Attributes:
        folder: tiled folder, as skyproof imagery tile writes it.
        out: tiled folder to write.
        detector: detector folder; finds vehicles that are not labelled.
        check_detector: detector folder that checks the result; the same detector by default.
        inpainting: TorchScript or torch.export file of a network that takes image and mask, such as LaMa.
        method: without a file: exemplar (ground copied from nearby), telea or navier-stokes (OpenCV's).
        finding_score: everything the detector finds with at least this score is removed.
        margin_m: by which vehicles' boxes are grown, in metres.
        largest_masked_share: tiles with more to remove than this are left out.
        device: auto, cpu or cuda; for the detectors.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    out: Path
    detector: Path | None = None
    check_detector: Path | None = None
    inpainting: Path | None = None
    method: Literal["exemplar", "telea", "navier-stokes"] = "exemplar"
    finding_score: float = ClearSettings.finding_score
    margin_m: float = ClearSettings.margin_m
    largest_masked_share: float = ClearSettings.largest_masked_share
    device: str = "auto"

    def run(self) -> None:
        """Clears the folder."""
        refuse_existing(self.out)
        settings = ClearSettings(
            finding_score=self.finding_score,
            margin_m=self.margin_m,
            largest_masked_share=self.largest_masked_share,
        )
        inpainting = self._inpainting()
        finder = _finder(self.detector, self.device)
        checker = _finder(self.check_detector, self.device) if self.check_detector else finder
        with finished_folder(self.out) as partial, ExitStack() as bars:
            updates = {}

            def progress(stage: str, done: int, total: int) -> None:
                if stage not in updates:
                    bars.close()
                    updates[stage] = bars.enter_context(progress_bar(f"{stage} vehicles"))
                updates[stage](done, total)

            record = clear_backgrounds(
                self.folder,
                partial,
                inpainting,
                settings,
                finder=finder,
                checker=checker,
                progress=progress,
            )
        totals = record["totals"]
        left_out = (
            ", ".join(f"{count} because {why}" for why, count in totals["left_out"].items())
            or "none"
        )
        say(f"Tiles: {totals['kept']} of {totals['tiles']} kept; left out: {left_out}.")
        for split in totals["splits_without_tiles"]:
            say(
                f"No tile of the split {split} is left; give more imagery before using this folder for it."
            )
        removed = totals["labelled_removed"] + totals["detected_removed"]
        say(f"Vehicles removed: {removed}; {totals['masked_share']:.1%} of the ground filled.")
        if checker is None:
            say("Not checked by a detector: a person has to look at every tile.")
        say(
            f"Look at {(self.out / 'sheets' / 'index.html').resolve()}; reject tiles with skyproof imagery drop."
        )

    def _inpainting(self) -> Inpainting:
        if self.inpainting is not None:
            return LearntInpainting(self.inpainting)
        inpainting = Exemplar() if self.method == "exemplar" else Diffusion(self.method)
        # Says at once when OpenCV is missing.
        inpainting.record()
        return inpainting


@dataclass(frozen=True)
class Drop:
    """Takes tiles that a person rejected out of a tiled folder's index; their pictures stay on disk.

    Attributes:
        folder: tiled or cleared folder.
        tiles: their ids, as on the sheets.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    tiles: tuple[str, ...]

    def run(self) -> None:
        """Rewrites the index."""
        emptied = drop_tiles(self.folder, self.tiles)
        say(f"Dropped {len(set(self.tiles))} tiles from {self.folder.resolve()}")
        for split in emptied:
            say(
                f"No tile of the split {split} is left; give more imagery before using this folder for it."
            )


def _finder(folder: Path | None, device: str) -> VehicleFinder | None:
    if folder is None:
        return None
    loaded = load_detector(folder)
    digest = weights_digest(loaded.detector)
    loaded.detector.to(choose_device(device))
    return VehicleFinder(loaded, f"{folder} ({digest[:12]})")
