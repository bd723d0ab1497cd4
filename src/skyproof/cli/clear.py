"""`skyproof clear`: vehicle-free backgrounds from real tiles."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from skyproof.console import say, stage_bars
from skyproof.errors import ConfigurationError
from skyproof.files import alone, finished_folder, refuse_existing

if TYPE_CHECKING:
    from skyproof.imagery.clearing.vehicle_masks import VehicleFinder

FAILED = "failed its precheck, so it does not check that no vehicle is left"


@dataclass(frozen=True)
class Clear:
    """Removes the vehicles from tiled imagery, so that it can serve as backgrounds.

    Labelled and detected vehicles are masked with their shadows and filled with ground. A detector
    checks the result, and sheets/index.html shows it. index.json records the places of the
    vehicles.

    Attributes:
        folder: tiled folder of `skyproof ground`; with `--reject` a cleared one.
        out: tiled folder to write; not with `--reject`.
        reject: ids of bad tiles to take out of a cleared folder, as on its sheets.
        detector: detector folder; it finds vehicles that are not labelled.
        check_detector: detector folder that checks the result; the same detector by default, unless
            it failed its precheck on more than random controls.
        device: auto, cpu or cuda.
    """

    folder: Positional[Path]
    out: Path | None = None
    reject: tuple[str, ...] = ()
    detector: Path | None = None
    check_detector: Path | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        if (self.out is None) == (not self.reject):
            raise ConfigurationError(
                "clear expects --out with a folder to write, or --reject with tiles of a cleared "
                f"folder, got {'neither' if self.out is None else 'both'}."
            )

    def run(self) -> None:
        if self.out is None:
            self._reject()
            return
        refuse_existing(self.out)
        checker = finder = _finder(self.detector, self.device)
        if self.check_detector is not None:
            checker = _finder(self.check_detector, self.device)
        elif self.detector is not None and failed_precheck(self.detector):
            say(f"{self.detector} {FAILED}; give another one as --check-detector.")
            checker = None
        clear_tiles(self.folder, self.out, finder, checker)

    def _reject(self) -> None:
        from skyproof.imagery.clearing.clear import reject_tiles
        from skyproof.imagery.words import emptied_words
        from skyproof.scenes.backgrounds import BackgroundSet

        # A folder that is no background set is refused before anything is written.
        BackgroundSet.open(self.folder)
        with alone(self.folder):
            emptied = reject_tiles(self.folder, self.reject)
        say(f"Took {len(set(self.reject))} tiles out of {self.folder.resolve()}")
        for line in emptied_words(emptied):
            say(line)


def failed_precheck(folder: Path) -> bool:
    """Says whether a detector's precheck found that it misses usual vehicles; False without one."""
    from skyproof.results.precheck import PRECHECK_FILE, misses_vehicles, read_precheck

    return (folder / PRECHECK_FILE).is_file() and misses_vehicles(read_precheck(folder))


def clear_tiles(
    folder: Path, out: Path, finder: "VehicleFinder | None", checker: "VehicleFinder | None"
) -> None:
    """Clears a tiled folder, and prints what was removed."""
    from skyproof.imagery.clearing.clear import clear_backgrounds
    from skyproof.imagery.words import cleared_words

    with finished_folder(out) as partial, stage_bars("vehicles") as update:
        record = clear_backgrounds(folder, partial, finder=finder, checker=checker, progress=update)
    for line in cleared_words(record, out, checked=checker is not None):
        say(line)


def _finder(folder: Path | None, device: str) -> "VehicleFinder | None":
    from skyproof.detectors.loaded import load_detector
    from skyproof.device import choose_device
    from skyproof.imagery.clearing.vehicle_masks import VehicleFinder

    if folder is None:
        return None
    return VehicleFinder.of_folder(load_detector(folder), folder, choose_device(device))
