"""Takes tiles that a person rejected out of a background set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from skyproof.datasets.annotations import ANNOTATIONS, drop_images
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import write_json
from skyproof.imagery.tiles.tile_index import copy_ground_index
from skyproof.layout import CLEARING_RECORD
from skyproof.scenes.background_index import write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS

_REMEDY = "copy the whole folder again, or clear the imagery again"


def reject_tiles(folder: Path, ids: Sequence[str]) -> list[str]:
    """Takes tiles that a person rejected out of the index and of the annotations of their splits.

    Their pictures stay where they are.

    Returns:
        Splits that have no tile any more.

    Raises:
        ConfigurationError: an id is not in the index, or none would stay.
        StoredFileError: the folder is not a background set, or an annotation file is damaged.
    """
    backgrounds = BackgroundSet.open(folder)
    tiles = backgrounds.all_tiles()
    unknown = sorted(set(ids) - {tile.id for tile in tiles})
    if unknown:
        raise ConfigurationError(f"{folder} has no tile {unknown[0]!r}; the ids are on the sheets.")
    kept = [tile for tile in tiles if tile.id not in set(ids)]
    if not kept:
        raise ConfigurationError(
            f"Every tile of {folder} would be rejected; clear the imagery again instead."
        )
    if (folder / CLEARING_RECORD).is_file():
        path = folder / CLEARING_RECORD
        record: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
        before = record.get("rejected", [])
        if not isinstance(before, list) or not all(isinstance(name, str) for name in before):
            raise StoredFileError(f"{path}, rejected: expected a list of tiles; {_REMEDY}.")
        write_json(path, {**record, "rejected": sorted({*before, *ids})})
    for split in SPLITS:
        if (folder / split / ANNOTATIONS).is_file():
            drop_images(folder / split, ids)
    copy_ground_index(folder, folder, {tile.id for tile in kept})
    write_index(folder, backgrounds.gsd_m, kept, backgrounds.sensor, backgrounds.light)
    return [
        split
        for split in SPLITS
        if any(t.split == split for t in tiles) and all(t.split != split for t in kept)
    ]
