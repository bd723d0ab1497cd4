"""Masks of what hides the ground on orthophotos, such as tree crowns and roofs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from skyproof.errors import ImageryError
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.georeference import image_name
from skyproof.imagery.tiles.grid import Cell
from skyproof.imagery.tiles.sources import Source, SourceReader, find_images, inspect_source
from skyproof.imagery.tiles.warp import CellImage, read_source


def find_covers(path: Path, sources: Sequence[Source], reader: SourceReader) -> list[Source]:
    """Finds the mask of each source: an image of its name and its size, lying where it lies.

    One mask of one source may have another name. Masks of map tiles lie in folders z/x/y as these.

    Args:
        path: one mask, or the folder of them.

    Raises:
        ImageryError: a source has no mask, or one of another size, or it cannot be read.
    """
    found = find_images([path])
    files = {image_name(file): file for file in found}
    if len(found) == len(sources) == 1:
        files = {image_name(sources[0].path): found[0]}
    masks = []
    for source in sources:
        file = files.get(image_name(source.path))
        if file is None:
            raise ImageryError(
                f"{path} holds no mask for {source.path.name}; add an image of the same name, "
                "black where nothing hides the ground."
            )
        gsd_m = max(source.georeference.gsd_m)
        mask = inspect_source(file, SourceSettings(gsd_m=gsd_m), reader)
        if (mask.width_px, mask.height_px) != (source.width_px, source.height_px):
            raise ImageryError(
                f"{file} has {mask.width_px} x {mask.height_px} pixels and {source.path.name} "
                f"{source.width_px} x {source.height_px}; give a mask of the same size."
            )
        masks.append(dataclasses.replace(mask, georeference=source.georeference))
    return masks


def cover_of(
    cell: Cell, image: CellImage, masks: Sequence[Source], reader: SourceReader
) -> UInt8[np.ndarray, "S S"]:
    """Cuts the masks as a cell's picture was cut, each pixel from the mask of its source.

    Where a mask has no data nothing hides the ground. A mask of zeros and ones counts as one of
    black and white.

    Raises:
        ImageryError: a mask cannot be read.
    """
    cover = np.zeros(image.owner.shape, np.uint8)
    for number in np.unique(image.owner[image.owner >= 0]):
        pixels, valid = read_source(masks[number], cell, reader)
        values = np.where(valid, pixels[0], 0).astype(np.uint8)
        own = image.owner == number
        cover[own] = (values * 255 if values.max() <= 1 else values)[own]
    return cover
