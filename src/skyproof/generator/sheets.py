"""Pictures of fits and of samples: for looking, not for measuring. Fits show the imagery."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from skyproof.files import write_beside
from skyproof.generator.fits import LARGEST_MISFIT, Fit, Prototype, fitted_texture
from skyproof.generator.fitting import Fitter
from skyproof.generator.fleet import VehicleGenerator, fleet_of, sample_learnt_fleet
from skyproof.generator.maps import whole
from skyproof.generator.photographed import Photographed, shown_pixels
from skyproof.randomness import generator_of
from skyproof.render.portrait import PART_COLOURS, close_up
from skyproof.vehicles.fleet import Fleet, FleetSettings
from skyproof.vehicles.vehicle import VehicleBatch

_SIDE_PX = 192
_CAPTION_PX = 16
_ROWS = 24
_SAMPLES, _ABREAST = 24, 3
_CLOSE_M, _COARSE_M = 0.016, 0.125
_SIDE_M = 6.4
_GREY = 0.5
_ROWS_BETWEEN, _STEPS_BETWEEN = 4, 7
Picture = UInt8[np.ndarray, "_ _ 3"]

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
        _save(folder / f"{number:05d}.png", rows)


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
    _save(folder / "samples.png", _sample_rows(fleet))
    _save(folder / "between.png", [_row(each) for each in ways])
    _save(folder / "turntable.png", [_turntable_row(fleet.batch([name])) for name in few])


def write_preview(path: Path, vehicles: VehicleGenerator, seed: int) -> None:
    """Writes some samples of a generator that still learns, always of the same draws."""
    generator = generator_of(seed, "preview")
    samples = [vehicles.sample(generator) for _ in range(_STEPS_BETWEEN)]
    _save(path, [_row(fleet_of(samples, vehicles.method))], compress_level=6)


def _save(path: Path, rows: Sequence[Picture], compress_level: int = 3) -> None:
    with write_beside(path) as temporary:
        sheet = Image.fromarray(np.concatenate(rows))
        sheet.save(temporary, compress_level=compress_level)


def _row(fleet: Fleet) -> Picture:
    """Draws vehicles side by side from above, and their part maps below."""
    close = close_up(fleet.batch(fleet.ids), gsd_m=_CLOSE_M, side_m=_SIDE_M)
    above = np.concatenate([*map(_cell, close)], axis=1)
    return np.concatenate([above, np.concatenate([*map(_parts, fleet.parts)], axis=1)])


def _turntable_row(vehicle: VehicleBatch) -> Picture:
    aslant = {"gsd_m": _CLOSE_M, "side_m": _ASLANT_SIDE_M, "tilt_rad": _ASLANT_RAD}
    turns = [2 * math.pi * number / _TURNS for number in range(_TURNS)]
    views = [close_up(vehicle, **aslant, heading_rad=turn)[0] for turn in turns]
    return np.concatenate([*map(_cell, views)], axis=1)


def _sample_rows(fleet: Fleet) -> list[Picture]:
    """Draws all vehicles of a fleet: at 1.6 cm per pixel, at 12.5 cm, and their part maps."""
    batch = fleet.batch(fleet.ids)
    views = [close_up(batch, gsd_m=gsd_m, side_m=_SIDE_M) for gsd_m in (_CLOSE_M, _COARSE_M)]
    cells = []
    for name, parts, close, coarse in zip(fleet.ids, fleet.parts, *views, strict=True):
        pictures = [_cell(close), _cell(coarse), _parts(parts)]
        cells.append(_captioned(np.concatenate(pictures, axis=1), name))
    while len(cells) % _ABREAST:
        cells.append(np.full_like(cells[0], 255))
    return [
        np.concatenate(cells[start : start + _ABREAST], axis=1)
        for start in range(0, len(cells), _ABREAST)
    ]


def _fit_row(
    fitter: Fitter, vehicle: Photographed, fit: Fit, prototypes: Sequence[Prototype]
) -> Picture:
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


def _cell(picture: UInt8[Tensor, "3 H W"] | Float[Tensor, "3 H W"]) -> Picture:
    """Pixels of photographs stay pixels; fine pictures are averaged."""
    if picture.dtype != torch.uint8:
        picture = (picture.detach() * 255).round().byte()
    small = picture.shape[1] < _SIDE_PX
    method = Image.Resampling.NEAREST if small else Image.Resampling.LANCZOS
    return _resized(picture.permute(1, 2, 0).numpy(), method)


def _parts(parts: UInt8[Tensor, "512 512"]) -> Picture:
    colours = np.array(list(PART_COLOURS.values()), dtype=np.uint8)
    return _resized(colours[parts.numpy()], Image.Resampling.NEAREST)


def _resized(pixels: Picture, method: Image.Resampling) -> Picture:
    return np.asarray(Image.fromarray(pixels).resize((_SIDE_PX, _SIDE_PX), method))


def _captioned(row: Picture, caption: str) -> Picture:
    picture = Image.new("RGB", (row.shape[1], row.shape[0] + _CAPTION_PX), "white")
    picture.paste(Image.fromarray(row), (0, _CAPTION_PX))
    ImageDraw.Draw(picture).text((4, 2), caption, fill="black")
    return np.asarray(picture)
