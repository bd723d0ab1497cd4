"""From photographs to a generator of vehicles: find them, fit them, learn from the good fits."""

import hashlib
import json
import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import alone, file_digest, refuse_links
from skyproof.generator.adversarial import AdversarialGenerator
from skyproof.generator.adversarial_training import learn_adversarially
from skyproof.generator.fits import (
    LARGEST_MISFIT,
    Fit,
    Fits,
    Prototype,
    draw_prototypes,
    fitted_vehicles,
)
from skyproof.generator.fitting import Fitter
from skyproof.generator.folder import read_generator_record, save_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.photographed import Photographed, photographed_vehicles
from skyproof.generator.settings import LearnSettings
from skyproof.generator.sheets import write_fit_sheets, write_sample_sheets
from skyproof.loop import Loop, refuse_other
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.vehicles.fleet import FleetSettings

LEAST_VEHICLES = 50
"""Fewest vehicles to learn from; a generator would only repeat fewer."""

UNSURE_BELOW = 0.002
"""Where the other direction fits worse by no more than this, nose and tail may be exchanged."""

_OTHER = "vehicles learnt from other photographs, or with other settings"
_CHECKPOINT_EVERY = 10


@dataclass(frozen=True)
class Imagery:
    """Photographs by one camera on one day.

    Attributes:
        tiles: with their vehicles, as `skyproof ground` cuts them.
        cleared: the same without them, as `skyproof clear` leaves them.
    """

    tiles: BackgroundSet
    cleared: BackgroundSet


def learn_vehicles(
    imagery: Sequence[Imagery],
    settings: LearnSettings,
    folder: Path,
    *,
    device: torch.device | str = "cpu",
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> dict[str, Any]:
    """Learns a generator of vehicles from photographs, and returns the record of `generator.json`.

    A stopped run goes on after the last stored fit or step, and ends at the same bytes. Fits do not
    depend on the method, so a copy of `fits/` saves another method the work.

    Args:
        imagery: photographs; each is fitted with its own sharpness and light.
        settings: how vehicles are fitted, and the method that learns from the fits.
        folder: gets the generator (see `load_generator`), `fits/` with sheets of all fits, and
            sheets of samples (see `write_sample_sheets`).
        device: where the network of "gan" is trained; all else works on the CPU.
        progress: called with ("fit" or "learn", done, in all).

    Raises:
        ConfigurationError: too few vehicles can be fitted, or were, or tiles do not belong
            together; says why.
        RunFolderError: the folder holds something else, or somebody else works there.
        StoredFileError: a tile or the checkpoint is damaged.
    """
    _refuse_unfit(imagery)
    found = [photographed_vehicles(each.tiles, each.cleared) for each in imagery]
    vehicles = [vehicle for own, _ in found for vehicle in own]
    left_out = sum((Counter(why) for _, why in found), Counter[str]())
    _refuse_few(len(vehicles), left_out, imagery)
    identity = {
        "settings": asdict(settings),
        "vehicles": [vehicle.scene.id for vehicle in vehicles],
        "gsd_m": imagery[0].tiles.gsd_m,
        "photographs": [_photographs_digest(each) for each in imagery],
    }
    text = json.dumps(identity, sort_keys=True)
    short = {"identity_sha256": hashlib.sha256(text.encode()).hexdigest()}
    with alone(folder):
        refuse_links(folder)
        if (folder / "generator.json").exists():
            record = read_generator_record(folder)
            refuse_other(folder, {name: record.get(name) for name in short}, short, _OTHER)
            return record
        prototypes = draw_prototypes(
            list(FleetSettings().weights), settings.fit.bodies, settings.seed
        )
        fitters: list[Fitter] = []
        for each, (own, _) in zip(imagery, found, strict=True):
            fitter = Fitter(each.tiles, each.cleared, prototypes, settings.fit)
            fitters += [fitter] * len(own)
        fits = _fit_all(fitters, vehicles, identity, folder / "fits", progress)
        kept = [fit for fit in fits if fit.misfit <= LARGEST_MISFIT]
        if len(kept) < len(fits):
            left_out[f"its fit is off by more than {LARGEST_MISFIT:g}"] = len(fits) - len(kept)
        _refuse_few(len(kept), left_out, imagery)
        learnt_from = fitted_vehicles(kept, prototypes)
        generator: LayeredGenerator | AdversarialGenerator
        if settings.method == "layered":
            generator = LayeredGenerator.learn(learnt_from)
        else:
            generator = learn_adversarially(
                learnt_from,
                settings.gan,
                folder / "gan",
                settings.seed,
                device,
                lambda row: progress("learn", row["step"], settings.gan.steps),
            )
        record = _record(settings, imagery, vehicles, kept, left_out, prototypes) | short
        write_fit_sheets(folder / "fits", fitters, vehicles, fits, prototypes)
        write_sample_sheets(folder, generator, settings.seed)
        save_generator(folder, generator, record)
    return record


def _photographs_digest(imagery: Imagery) -> str:
    """Computes the SHA-256 over all files of a pair of folders, wherever these lie."""
    total = hashlib.sha256()
    for backgrounds in (imagery.tiles, imagery.cleared):
        names = ["index.json"]
        for tile in backgrounds.all_tiles():
            names += [name for name in (tile.file, tile.shade, tile.cover) if name]
        for name in names:
            path = backgrounds.folder / name
            if not path.is_file():
                raise StoredFileError(f"{path} is missing; copy the whole folder again.")
            total.update(f"{name} {file_digest(path)}\n".encode())
    return total.hexdigest()


def _fit_all(
    fitters: Sequence[Fitter],
    vehicles: list[Photographed],
    identity: dict[str, Any],
    folder: Path,
    progress: Callable[[str, int, int], None],
) -> list[Fit]:
    fits = Fits([vehicle.scene.id for vehicle in vehicles])
    # The method is left out, because fits serve every method.
    settings = {name: identity["settings"][name] for name in ("seed", "fit")}
    loop = Loop(
        folder,
        identity | {"settings": settings},
        len(vehicles),
        _CHECKPOINT_EVERY,
        {"fits": fits},
        other=_OTHER,
        remedy=f"remove {folder} and learn again",
    )
    loop.resume()
    for step in loop:
        fit = fitters[step - 1](vehicles[step - 1])
        fits.done.append(fit)
        told = ("misfit", "prototype", "reversed", "runner_up")
        loop.report({"step": step, "vehicle": fit.id} | {name: getattr(fit, name) for name in told})
        progress("fit", step, len(vehicles))
    return fits.done


def _refuse_unfit(imagery: Sequence[Imagery]) -> None:
    if not imagery:
        raise ConfigurationError(
            "Learning vehicles expects photographs, got none; give the tiles that skyproof ground "
            "cut, and after them what skyproof clear made of these."
        )
    first = imagery[0].tiles
    for each in imagery[1:]:
        if each.tiles.gsd_m != first.gsd_m:
            raise ConfigurationError(
                f"{each.tiles.folder} has {each.tiles.gsd_m:g} m per pixel and {first.folder} "
                f"{first.gsd_m:g}; cut both alike with skyproof ground --tiling.gsd-m."
            )


def _refuse_few(count: int, left_out: Mapping[str, int], imagery: Sequence[Imagery]) -> None:
    if count >= LEAST_VEHICLES:
        return
    reasons = ", ".join(f"{number} because {why}" for why, number in left_out.items())
    folders = ", ".join(str(each.cleared.folder) for each in imagery)
    raise ConfigurationError(
        f"Learning vehicles expects at least {LEAST_VEHICLES} that can be fitted, got {count} of "
        f"{folders}{f' (left out: {reasons})' if reasons else ''}; give more imagery."
    )


def _record(
    settings: LearnSettings,
    imagery: Sequence[Imagery],
    vehicles: list[Photographed],
    kept: list[Fit],
    left_out: Mapping[str, int],
    prototypes: list[Prototype],
) -> dict[str, Any]:
    headings = Counter(vehicle.heading_from for vehicle in vehicles)
    types = Counter(prototypes[fit.prototype].body_type for fit in kept)
    tiles = [tile for each in imagery for tile in each.cleared.all_tiles()]
    return {
        "method": settings.method,
        "settings": asdict(settings),
        "gsd_m": imagery[0].tiles.gsd_m,
        "vehicles": len(kept),
        "left_out": dict(left_out),
        "body_types": dict(sorted(types.items())),
        "headings_from": dict(sorted(headings.items())),
        "unsure_directions": sum(fit.runner_up < UNSURE_BELOW for fit in kept),
        "misfit": round(statistics.median(fit.misfit for fit in kept), 4),
        "licences": sorted({tile.licence or "not stated" for tile in tiles}),
    }
