"""`skyproof clear`: vehicle-free backgrounds from real tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from skyproof.cli.console import progress_bar, say
from skyproof.errors import ConfigurationError
from skyproof.files import alone, finished_folder, refuse_existing
from skyproof.imagery.settings import ClearSettings

if TYPE_CHECKING:
    from skyproof.detectors.loaded import Load
    from skyproof.imagery.clearing.vehicle_finder import VehicleFinder

_MANY_MORE = 3
"""A detector that finds so many times what is labelled mostly finds what is no vehicle."""
_LARGE_SHARE = 0.10


@dataclass(frozen=True)
class Clear:
    """Removes the vehicles from tiled imagery, so that it can serve as backgrounds.

    Labelled vehicles and what a detector finds are masked with their shadows and filled with
    ground; a detector checks the result, and sheets/index.html shows a person what was done. Where
    and how the vehicles stood is kept in index.json, for scenes with vehicles at their places. Give
    the cleared folder with --reject to take out the tiles that do not look right.

    Attributes:
        folder: tiled folder, as `skyproof ground` writes it from imagery; with --reject a cleared
            one.
        out: tiled folder to write; not with --reject.
        reject: ids of tiles to take out of a cleared folder, as on its sheets, with their
            annotations. Their pictures stay on disk.
        detector: detector folder; it finds vehicles that are not labelled.
        check_detector: detector folder that checks the result; the same detector by default, unless
            its own check failed.
        device: auto, cpu or cuda; where the detectors run.
        settings: how vehicles are removed.
    """

    folder: Positional[Path]
    out: Path | None = None
    reject: tuple[str, ...] = ()
    detector: Path | None = None
    check_detector: Path | None = None
    device: str = "auto"
    settings: ClearSettings = field(default_factory=ClearSettings)

    def __post_init__(self) -> None:
        if (self.out is None) == (not self.reject):
            raise ConfigurationError(
                "clear expects --out with a folder to write, or --reject with tiles of a cleared "
                f"folder, got {'neither' if self.out is None else 'both'}."
            )

    def run(self, load: Load | None = None) -> None:
        """Clears the folder, or takes rejected tiles out of it.

        Args:
            load: gives the detector of a folder, where a folder alone does not hold it.
        """
        from skyproof.imagery.clearing.clear import clear_backgrounds

        if self.out is None:
            self._reject()
            return
        refuse_existing(self.out)
        finder = _finder(self.detector, self.device, load)
        checker = finder
        if self.check_detector is not None:
            checker = _finder(self.check_detector, self.device, load)
        elif self.detector is not None and (failed := _failed_check(self.detector)):
            say(failed)
            checker = None
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
                self.settings,
                finder=finder,
                checker=checker,
                progress=progress,
            )
        self._say_record(record, self.out, checked=checker is not None)

    def _reject(self) -> None:
        from skyproof.imagery.clearing.rejecting import reject_tiles
        from skyproof.scenes.backgrounds import BackgroundSet

        # A folder that is no background set is refused before anything is written.
        BackgroundSet.open(self.folder)
        with alone(self.folder):
            emptied = reject_tiles(self.folder, self.reject)
        say(f"Took {len(set(self.reject))} tiles out of {self.folder.resolve()}")
        _say_emptied(emptied)

    def _say_record(self, record: dict[str, Any], out: Path, *, checked: bool) -> None:
        totals = record["totals"]
        reasons = [f"{count} because {why}" for why, count in totals["left_out"].items()]
        left_out = ", ".join(reasons) or "none"
        say(f"Tiles: {totals['kept']} of {totals['tiles']} kept; left out: {left_out}.")
        _say_emptied(totals["splits_without_tiles"])
        removed = totals["labelled_removed"] + totals["detected_removed"]
        say(
            f"Vehicles removed: {removed}; {totals['masked_share']:.1%} of the ground filled; the "
            f"places of {totals['places']} are kept for skyproof scenes --settings.places removed."
        )
        for sentence in warnings(totals, record["vehicles_from"]):
            say(f"WARNING: {sentence}")
        say_light(record)
        if not checked:
            say("Not checked by a detector: a person has to look at every tile.")
        sheet = (out / "sheets" / "index.html").resolve()
        say(f"Look at {sheet}; take tiles out with skyproof clear {out} --reject TILE.")


def _say_emptied(splits: Sequence[str]) -> None:
    for split in splits:
        say(
            f"No tile of the split {split} is left; give more imagery before using this folder "
            "for it."
        )


def say_light(record: dict[str, Any]) -> None:
    """Says over how many sources the sun is known, and what is done with the others.

    Args:
        record: of `clear_backgrounds`.
    """
    from skyproof.imagery.clearing.shared_sun import KNOWN_FROM

    suns, overcast, photographs = record["suns"], record["overcast"], record["photographs"]
    sunny = [sun for name, sun in suns.items() if name not in overcast]
    if sunny:
        elevations_deg = [math.degrees(sun["elevation_rad"]) for sun in sunny]
        shared = sum(sun["known_from"] == KNOWN_FROM for sun in sunny)
        taken = f", that of {shared} taken from the others, which agree" if shared else ""
        say(
            f"Sun known over {len(sunny)} of {photographs} sources, {min(elevations_deg):.0f} to "
            f"{max(elevations_deg):.0f} degrees high{taken}: vehicles will stand in it, and in the "
            f"shadows that were found on {len(record['shaded'])} tiles."
        )
    if overcast:
        say(
            f"Overcast: over {len(overcast)} of {photographs} sources vehicles cast no shadow (or "
            "too few stand to tell, and nearly all others are overcast), so they will be drawn in "
            "the sky's light alone."
        )
    unknown = photographs - len(sunny) - len(overcast)
    if unknown:
        say(
            f"Where the sun stood over {unknown} of {photographs} sources is not known (too few "
            "vehicles with clear shadows): scenes will draw any sun."
        )


def warnings(totals: dict[str, Any], vehicles_from: list[str]) -> list[str]:
    """Says in a sentence each what hints that ground was smeared in place of vehicles.

    Args:
        totals: of the record of `clear_backgrounds`.
        vehicles_from: who said where vehicles stand, also of the record.
    """
    sentences = []
    labelled, detected = totals["labelled_removed"], totals["detected_removed"]
    if "labels" in vehicles_from and detected > _MANY_MORE * max(labelled, 1):
        sentences.append(
            f"{detected} removed vehicles were only found by the detector, and {labelled} are "
            "labelled: most of what it finds here may be no vehicle; look at the sheet, and take "
            "another detector or a higher --settings.finding-score of skyproof clear."
        )
    if totals["masked_share"] > _LARGE_SHARE:
        sentences.append(
            f"{totals['masked_share']:.0%} of the ground was filled, more than the "
            f"{_LARGE_SHARE:.0%} of a place with many vehicles: detectors will be tested on "
            "painted-over ground; look at the sheet, and take another detector or a higher "
            "--settings.finding-score of skyproof clear."
        )
    return sentences


def _failed_check(folder: Path) -> str | None:
    """Says why a detector may not certify that no vehicle is left; None where it may.

    One that was not checked may.
    """
    from skyproof.results.findings import findings, verdict
    from skyproof.results.precheck import PRECHECK_FILE, read_precheck

    if not (folder / PRECHECK_FILE).is_file():
        return None
    if verdict(findings(read_precheck(folder))) != "failed":
        return None
    return (
        f"{folder} failed its own check ({PRECHECK_FILE}), so it finds vehicles here, but cannot "
        "tell that none is left; give another one as --check-detector."
    )


def _finder(folder: Path | None, device: str, load: Load | None) -> VehicleFinder | None:
    from torch import nn

    from skyproof.cli.device import choose_device
    from skyproof.detectors.loaded import load_detector
    from skyproof.detectors.weights import weights_digest
    from skyproof.imagery.clearing.vehicle_finder import VehicleFinder

    if folder is None:
        return None
    loaded = (load or load_detector)(folder)
    if not isinstance(loaded.detector, nn.Module):
        return VehicleFinder(loaded, f"{folder} (by its answers)")
    digest = weights_digest(loaded.detector)
    loaded.detector.to(choose_device(device))
    return VehicleFinder(loaded, f"{folder} ({digest[:12]})")
