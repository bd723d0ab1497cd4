"""Pictures of fits and of samples: for looking, not for measuring. Fits show the imagery."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from skyproof.generator.fits import LARGEST_MISFIT, Fit, Prototype, fitted_texture
from skyproof.generator.fitting import Fitter
from skyproof.generator.fleet import VehicleGenerator, sample_learnt_fleet
from skyproof.generator.maps import whole
from skyproof.generator.photographed import Photographed, shown_pixels
from skyproof.pictures import write_png
from skyproof.randomness import generator_of
from skyproof.render.portrait import PART_COLOURS, captioned, close_up
from skyproof.vehicles.fleet import Fleet, FleetSettings

_SIDE_PX = 192
_ROWS = 24
_SAMPLES, _ABREAST = 24, 3
_CLOSE_M, _COARSE_M = 0.016, 0.125
_SIDE_M = 6.4
_GREY = 0.5
Picture = UInt8[np.ndarray, "_ _ 3"]


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
        write_png(folder / f"{number:05d}.png", np.concatenate(rows), 3)


def write_sample_sheets(folder: Path, vehicles: VehicleGenerator, seed: int) -> None:
    """Writes a sheet that shows how good a generator is.

    `samples.png` has 24 samples from above, finely and as detectors see them, and their part maps.
    """
    generator = generator_of(seed, "sheet")
    fleet = sample_learnt_fleet(vehicles, FleetSettings(_SAMPLES), generator=generator)
    write_png(folder / "samples.png", np.concatenate(_sample_rows(fleet)), 3)


def _sample_rows(fleet: Fleet) -> list[Picture]:
    """Draws all vehicles of a fleet: at 1.6 cm per pixel, at 12.5 cm, and their part maps."""
    batch = fleet.batch(fleet.ids)
    views = [close_up(batch, gsd_m=gsd_m, side_m=_SIDE_M) for gsd_m in (_CLOSE_M, _COARSE_M)]
    cells = []
    for name, parts, close, coarse in zip(fleet.ids, fleet.parts, *views, strict=True):
        pictures = [_cell(close), _cell(coarse), _parts(parts)]
        cells.append(captioned(np.concatenate(pictures, axis=1), name))
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
    return captioned(np.concatenate(pictures, axis=1), caption)


def _cell(picture: UInt8[Tensor, "3 H W"] | Float[Tensor, "3 H W"]) -> Picture:
    """Scales a picture: a photograph's pixels stay visible, fine pictures are averaged."""
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
