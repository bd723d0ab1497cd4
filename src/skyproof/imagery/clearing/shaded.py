"""Gives cleared tiles the shadows that trees and buildings cast on them, and the sky's light."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from skyproof.imagery.clearing.cast_shadows import (
    CastShadow,
    find_cast_shadows,
    light_left,
    shade_map,
)
from skyproof.imagery.clearing.sunlight import OVERCAST_SKY, by_picture, picture_of, sky_of
from skyproof.imagery.exposure import some_of
from skyproof.scenes.background_index import BackgroundTile, save_map
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light


def shaded_tiles(backgrounds: BackgroundSet) -> list[BackgroundTile]:
    """Returns a set's tiles with maps of shadows, written to its folder, and with the sky's light.

    The sky's part of the light is what is left in the cast shadows of a photograph, on up to 31 of
    its tiles. Where they show too little of it, where the sun is not known, and under an overcast
    sky, nothing changes; drawn ground and maps that are there stay.

    Args:
        backgrounds: a cleared set, so that no vehicle is taken for a shadow.

    Raises:
        RunFolderError: the disk cannot take it.
    """
    tiles = backgrounds.all_tiles()
    shaded: dict[str, BackgroundTile] = {}
    for own in by_picture(tiles).values():
        shaded.update({tile.id: tile for tile in _shaded(backgrounds, own)})
    return [shaded.get(tile.id, tile) for tile in tiles]


def lights_record(
    tiles: Sequence[BackgroundTile],
    lights: Mapping[str, Light | None],
    kept: Sequence[BackgroundTile],
) -> dict[str, Any]:
    """Says which photographs know their sun, which are overcast, and which tiles have shadows.

    Args:
        tiles: all tiles, cleared or not.
        lights: what `measured_lights` gives.
        kept: the cleared tiles, as `shaded_tiles` gives them.
    """
    known = {
        picture_of(tile): light
        for tile in tiles
        if tile.kind is None and (light := lights[tile.id]) is not None
    }
    return {
        "suns": {name: asdict(light.sun) for name, light in known.items() if light.sun is not None},
        "overcast": [name for name, light in known.items() if light.sky == OVERCAST_SKY],
        "photographs": len(known),
        "shaded": [tile.id for tile in kept if tile.kind is None and tile.shade is not None],
    }


def _shaded(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile]
) -> Iterator[BackgroundTile]:
    """Shades the tiles of one picture."""
    known = {tile.id: _shadows(backgrounds, tile) for tile in some_of(tiles)}
    left = light_left(shadow for shadows in known.values() for shadow in shadows)
    if left is None:
        return
    for tile in tiles:
        light = replace(tile.light or backgrounds.light, sky=sky_of(left))
        shade = tile.shade
        if shade is None:
            shadows = known[tile.id] if tile.id in known else _shadows(backgrounds, tile)
            size_px = (tile.height_px, tile.width_px)
            values = shade_map(shadows, left, size_px, gsd_m=backgrounds.gsd_m)
            shade = save_map(backgrounds.folder, "shade", tile.id, values)
        yield replace(tile, light=light, shade=shade)


def _shadows(backgrounds: BackgroundSet, tile: BackgroundTile) -> list[CastShadow]:
    light = tile.light or backgrounds.light
    if light.sun is None or light.sky == OVERCAST_SKY:
        return []
    return find_cast_shadows(backgrounds.pixels(tile.id), light, light.sun, gsd_m=backgrounds.gsd_m)
