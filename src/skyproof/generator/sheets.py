"""Pictures of fits and of samples: for looking, not for measuring. Fits show the imagery."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from skyproof.files import write_beside
from skyproof.generator.fits import LARGEST_MISFIT, Fit, fitted_texture
from skyproof.generator.fitting import Fitter
from skyproof.generator.fleet import VehicleGenerator, fleet_of, sample_learnt_fleet
from skyproof.generator.maps import whole
from skyproof.generator.photographed import Photographed, shown_pixels
from skyproof.generator.prototypes import Prototype
from skyproof.randomness import generator_of
from skyproof.render.portrait import PART_COLOURS, close_up
from skyproof.vehicles.fleet import Fleet, FleetSettings
from skyproof.vehicles.vehicle import VehicleBatch

_SIDE_PX = 192
_CAPTION_PX = 16
_ROWS = 24
_SAMPLES, _COLUMNS = 24, 6
_CLOSE_M, _COARSE_M = 0.016, 0.125
_SIDE_M = 6.4
_GREY = 0.5
_ROWS_BETWEEN, _STEPS_BETWEEN = 4, 7
_TURNS, _ASLANT_RAD, _ASLANT_SIDE_M = 7, math.radians(50), 7.6


def write_fit_sheets(
    folder: Path,
    fitters: Sequence[Fitter],
    vehicles: Sequence[Photographed],
    fits: Sequence[Fit],
    prototypes: Sequence[Prototype],
) -> None:
    """Writes all fits, worst first, as sheets `00001.png` and so on.

    Each row has the photograph, the fit, their difference twice enlarged, the vehicle cut out of
    the photograph, the texture, the part map and how much of it the photograph shows. Every fit has
    its own fitter and vehicle.
    """
    order = sorted(range(len(fits)), key=lambda index: -fits[index].misfit)
    for number, start in enumerate(range(0, len(order), _ROWS), start=1):
        rows = [
            _fit_row(fitters[index], vehicles[index], fits[index], prototypes)
            for index in order[start : start + _ROWS]
        ]
        with write_beside(folder / f"{number:05d}.png") as temporary:
            Image.fromarray(np.concatenate(rows)).save(temporary, compress_level=3)


def write_sample_sheets(folder: Path, vehicles: VehicleGenerator, seed: int) -> None:
    """Writes what shows whether a generator is any good.

    These are `samples.png`, 24 samples from above, finely and as detectors see them, and their part
    maps; `between.png`, where every row leads from one sample to another; and `turntable.png`, some
    samples aslant, from all sides.
    """
    generator = generator_of(seed, "sheet")
    fleet = sample_learnt_fleet(vehicles, FleetSettings(_SAMPLES), generator=generator)
    few = fleet.ids[:: max(1, len(fleet) // _ROWS_BETWEEN)][:_ROWS_BETWEEN]
    ways = [
        fleet_of(vehicles.between(_STEPS_BETWEEN, generator), vehicles.method)
        for _ in range(_ROWS_BETWEEN)
    ]
    sheets = {
        "samples": fleet_sheet(fleet),
        "between": np.concatenate([_row(each) for each in ways]),
        "turntable": np.concatenate([_turntable_row(fleet.batch([name])) for name in few]),
    }
    for name, sheet in sheets.items():
        with write_beside(folder / f"{name}.png") as temporary:
            Image.fromarray(sheet).save(temporary, compress_level=3)


def write_preview(path: Path, vehicles: VehicleGenerator, seed: int) -> None:
    """Writes some samples of a generator that still learns, always of the same draws."""
    generator = generator_of(seed, "preview")
    samples = [vehicles.sample(generator) for _ in range(_STEPS_BETWEEN)]
    with write_beside(path) as temporary:
        Image.fromarray(_row(fleet_of(samples, vehicles.method))).save(temporary)


def _row(fleet: Fleet) -> UInt8[np.ndarray, "H W 3"]:
    """Draws vehicles side by side from above, and their part maps below."""
    close = close_up(fleet.batch(fleet.ids), gsd_m=_CLOSE_M, side_m=_SIDE_M)
    above = [_cell(picture.float() / 255) for picture in close]
    parts = [_parts(each) for each in fleet.parts]
    return np.concatenate([np.concatenate(above, axis=1), np.concatenate(parts, axis=1)])


def _turntable_row(vehicle: VehicleBatch) -> UInt8[np.ndarray, "H W 3"]:
    turns = [2 * math.pi * number / _TURNS for number in range(_TURNS)]
    views = [
        close_up(
            vehicle,
            gsd_m=_CLOSE_M,
            side_m=_ASLANT_SIDE_M,
            tilt_rad=_ASLANT_RAD,
            heading_rad=turn,
        )[0]
        for turn in turns
    ]
    return np.concatenate([_cell(view.float() / 255) for view in views], axis=1)


def fleet_sheet(fleet: Fleet) -> UInt8[np.ndarray, "H W 3"]:
    """Draws all vehicles of a fleet: at 1.6 cm per pixel, at 12.5 cm, and their part maps."""
    batch = fleet.batch(fleet.ids)
    close = close_up(batch, gsd_m=_CLOSE_M, side_m=_SIDE_M)
    coarse = close_up(batch, gsd_m=_COARSE_M, side_m=_SIDE_M)
    cells = []
    for index, name in enumerate(fleet.ids):
        parts = _parts(fleet.parts[index])
        pictures = [_cell(close[index].float() / 255), _cell(coarse[index].float() / 255), parts]
        cells.append(_captioned(np.concatenate(pictures, axis=1), name))
    while len(cells) % (_COLUMNS // 2):
        cells.append(np.full_like(cells[0], 255))
    rows = [
        np.concatenate(cells[start : start + _COLUMNS // 2], axis=1)
        for start in range(0, len(cells), _COLUMNS // 2)
    ]
    return np.concatenate(rows)


def _fit_row(
    fitter: Fitter, vehicle: Photographed, fit: Fit, prototypes: Sequence[Prototype]
) -> UInt8[np.ndarray, "H W 3"]:
    prototype = prototypes[fit.prototype]
    photograph, rendered = fitter.pictures(vehicle, fit)
    shown = shown_pixels(vehicle).float()
    pictures = [
        _cell(photograph),
        _cell(rendered),
        _cell((_GREY + 2 * (rendered - photograph) * shown).clamp(0.0, 1.0)),
        _cell(photograph * shown + _GREY * (1 - shown)),
        _cell(fitted_texture(fit, prototype)),
        _parts(prototype.parts),
        _cell(whole(fit.seen).expand(3, -1, -1)),
    ]
    state = "" if fit.misfit <= LARGEST_MISFIT else "DROPPED: "
    caption = f"{state}{fit.id}, {prototype.body_type}, off by {fit.misfit:.3f}"
    return _captioned(np.concatenate(pictures, axis=1), caption)


def _cell(picture: Float[Tensor, "3 H W"]) -> UInt8[np.ndarray, "S S 3"]:
    array = (picture.detach().permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    large = Image.fromarray(array).resize((_SIDE_PX, _SIDE_PX), _resampling(array.shape[0]))
    return np.asarray(large)


def _resampling(side_px: int) -> Image.Resampling:
    """Pixels of photographs stay pixels; fine pictures are averaged."""
    return Image.Resampling.NEAREST if side_px < _SIDE_PX else Image.Resampling.LANCZOS


def _parts(parts: UInt8[Tensor, "512 512"]) -> UInt8[np.ndarray, "S S 3"]:
    colours = np.array(list(PART_COLOURS.values()), dtype=np.uint8)[parts.numpy()]
    picture = Image.fromarray(colours).resize((_SIDE_PX, _SIDE_PX), Image.Resampling.NEAREST)
    return np.asarray(picture)


def _captioned(row: UInt8[np.ndarray, "H W 3"], caption: str) -> UInt8[np.ndarray, "H2 W 3"]:
    picture = Image.new("RGB", (row.shape[1], row.shape[0] + _CAPTION_PX), "white")
    picture.paste(Image.fromarray(row), (0, _CAPTION_PX))
    ImageDraw.Draw(picture).text((4, 2), caption, fill="black")
    return np.asarray(picture)
