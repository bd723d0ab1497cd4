"""The light of tiles: exposure as measured, and the sun of a date and time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import torch
from astral import Observer
from astral.sun import azimuth, elevation
from jaxtyping import Float
from rasterio.crs import CRS
from torch import Tensor

from skyproof.errors import ImageryError
from skyproof.imagery.exposure import ground_pixels, measure_exposure, some_of
from skyproof.imagery.tiles.georeference import to_reference_system
from skyproof.imagery.tiles.grid import Cell
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate

_DEGREES = CRS.from_epsg(4326)
_NORTH_M = 100.0
# A sun that is lower lights no photograph that one would count vehicles in.
_LOWEST_DEG = 5.0


def lit_tiles(
    folder: Path,
    tiles: Sequence[BackgroundTile],
    gsd_m: float,
    suns: Mapping[str, SunEstimate],
    vehicles_px: Mapping[str, Float[Tensor, "n 2"]],
    notes: list[str],
) -> list[BackgroundTile]:
    """Measures how each source shows light, on up to 31 of its tiles, and gives it to its tiles.

    Args:
        folder: of the background set, with the tiles' pictures.
        suns: over the tiles, by their ids, where it is known when they were photographed.
        vehicles_px: the middles of the vehicles that are known to stand on tiles, by their ids.
        notes: what was measured, and which sources show too little for that, is said here.
    """
    backgrounds = BackgroundSet(folder, gsd_m, tiles)
    of_source: dict[str, list[BackgroundTile]] = {}
    for tile in tiles:
        of_source.setdefault(tile.source, []).append(tile)
    measured: dict[str, Light] = {}
    nobody = torch.zeros(0, 2)
    for source, own in of_source.items():
        try:
            measured[source] = measure_exposure(
                ground_pixels(
                    backgrounds.pixels(tile.id), vehicles_px.get(tile.id, nobody), gsd_m=gsd_m
                )
                for tile in some_of(own)
            )
        except ImageryError:
            notes.append(
                f"{source}: too plain to measure its exposure; vehicles will be drawn as on a "
                "clear day, well exposed"
            )
    if measured:
        whites = [sum(light.white) / 3 for light in measured.values()]
        notes.append(
            f"exposure measured: white in the open sun would be shown as {min(whites):.2f} to "
            f"{max(whites):.2f} of the brightest value; vehicles will be drawn alike"
        )
    lit = []
    for tile in tiles:
        light = replace(measured.get(tile.source, Light()), sun=suns.get(tile.id))
        lit.append(replace(tile, light=light))
    return lit


def sun_over(cell: Cell, taken: datetime) -> SunEstimate:
    """Computes where the sun stood over a cell, in its axes; refraction is left out.

    Grid north is told from true north.

    Raises:
        ImageryError: the cell has no georeference, or the sun was lower than 5 degrees.
    """
    left, bottom, right, top = cell.extent
    middle = ((left + right) / 2, (bottom + top) / 2)
    above = (middle[0], middle[1] + _NORTH_M)
    if cell.crs is None:
        raise ImageryError(
            "--source.taken expects georeferenced images, because the sun of a date and time "
            "depends on the place, but some have no georeference; leave it out, and let "
            "`skyproof clear` measure the sun from the vehicles' shadows."
        )
    (longitude, latitude), (east, north) = to_reference_system(cell.crs, _DEGREES, [middle, above])
    # True north lies so far clockwise of the cell's y axis.
    grid_rad = math.atan2((east - longitude) * math.cos(math.radians(latitude)), north - latitude)
    place = Observer(latitude, longitude)
    height_deg = elevation(place, taken, with_refraction=False)
    if height_deg < _LOWEST_DEG:
        raise ImageryError(
            f"--source.taken expects a time of day, but at {taken.isoformat()} the sun stood at "
            f"{height_deg:.0f} degrees over {latitude:.2f} N, {longitude:.2f} E; check the time "
            "zone."
        )
    from_grid_north_rad = math.radians(azimuth(place, taken)) - grid_rad
    return SunEstimate(
        azimuth_rad=round((math.pi / 2 - from_grid_north_rad) % (2 * math.pi), 4),
        elevation_rad=round(math.radians(height_deg), 4),
        known_from=f"date and time, {taken.isoformat()}",
    )
