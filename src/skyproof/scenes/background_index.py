"""The index of a background set: its tiles, and the sensor of the photographs."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8
from msgspec import Meta
from torch import Tensor

from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import inside, write_json
from skyproof.pictures import write_png
from skyproof.ranges import FileReference, GroundResolution, ImageSide, Name
from skyproof.scenes.light import Light
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.sensor import PAPER_BLUR_SIGMA_PX, Sensor
from skyproof.scenes.splits import Split

_INDEX = "index.json"
REMEDY = "copy the whole folder again, or cut the backgrounds again"
MapKind = Literal["drivable", "shade", "cover"]
_Offset = Annotated[int, Meta(ge=-(10**12), le=10**12)]


@dataclass(frozen=True)
class BackgroundTile:
    """One tile of a background set; its files lie inside the folder.

    Attributes:
        id: unique in the set; the cluster of the bootstrap.
        source: source image, or "procedural".
        flight: name of the photographs that share their light; None if only the source does.
        offset_px: left and top edge in the grid of tiles, in pixels.
        kind: content of a procedural tile.
        sensor, light: those of this tile, if they are not the set's.
        removed: vehicles that stood on it before it was cleared.
        drivable: map of places for vehicles (`skyproof.scenes.directions`).
        shade: map of shadows; at a value of v they block v / 255 of the direct sun.
        cover: map of crowns, roofs and other cover; at a value of v they cover v / 255 of a pixel.
    """

    id: Name
    file: FileReference
    split: Split
    width_px: ImageSide
    height_px: ImageSide
    source: str
    offset_px: tuple[_Offset, _Offset] = (0, 0)
    kind: str | None = None
    flight: Annotated[str, Meta(max_length=400)] | None = None
    licence: str | None = None
    sensor: Sensor | None = None
    light: Light | None = None
    removed: tuple[RemovedVehicle, ...] = ()
    drivable: FileReference | None = None
    shade: FileReference | None = None
    cover: FileReference | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Its picture and its maps."""
        maps = (self.drivable, self.shade, self.cover)
        return (self.file, *(file for file in maps if file is not None))


@dataclass(frozen=True)
class BackgroundIndex:
    """The content of `index.json`; without a sensor vehicles have the paper's blur."""

    format_version: Literal[1]
    gsd_m: GroundResolution
    tiles: Annotated[tuple[BackgroundTile, ...], Meta(min_length=1)]
    sensor: Sensor = Sensor(PAPER_BLUR_SIGMA_PX)  # noqa: RUF009 (frozen)
    light: Light = Light()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        ids: set[str] = set()
        files: set[str] = set()
        for tile in self.tiles:
            if tile.id in ids or files & {*tile.files} or len({*tile.files}) < len(tile.files):
                raise StoredFileError(f"two tiles are called {tile.id}, or are {tile.file}")
            if not all(file.endswith(".png") for file in tile.files):
                raise StoredFileError(f"the tile {tile.id} is no .png file")
            for place in tile.removed:
                if not (0 <= place.x_px <= tile.width_px and 0 <= place.y_px <= tile.height_px):
                    raise StoredFileError(
                        f"a vehicle was removed at ({place.x_px:g}, {place.y_px:g}) px, outside "
                        f"the tile {tile.id} of {tile.width_px} x {tile.height_px} px"
                    )
            ids.add(tile.id)
            files.update(tile.files)


def read_index(folder: Path) -> BackgroundIndex:
    """Reads the index of a background set; an invalid one raises StoredFileError."""
    path = folder / _INDEX
    index: BackgroundIndex = read_document(path, BackgroundIndex, REMEDY)
    for tile in index.tiles:
        for file in tile.files:
            inside(folder, file, path)
    return index


def save_tile(folder: Path, tile: BackgroundTile, image: UInt8[Tensor, "3 H W"]) -> None:
    """Writes a tile's picture whole or not at all."""
    write_png(Path(folder) / tile.file, image.permute(1, 2, 0).contiguous().numpy(), 3)


def save_map(
    folder: Path, kind: MapKind, tile_id: str, values: UInt8[np.ndarray, "H W"]
) -> str | None:
    """Writes one of a tile's maps and returns its file; a map of zeros is not written (None)."""
    if not values.any():
        return None
    file = f"{kind}/{tile_id}.png"
    write_png(Path(folder) / file, values)
    return file


def write_index(
    folder: Path,
    gsd_m: float,
    tiles: Sequence[BackgroundTile],
    sensor: Sensor | None = None,
    light: Light | None = None,
) -> None:
    """Writes the index last: a folder without one is not a background set."""
    index = {
        "format_version": 1,
        "gsd_m": gsd_m,
        "sensor": dataclasses.asdict(sensor or Sensor()),
        "light": dataclasses.asdict(light or Light()),
        "tiles": [dataclasses.asdict(tile) for tile in tiles],
    }
    write_json(Path(folder) / _INDEX, index)


def change_sensors(folder: Path, change: Callable[[Sensor], Sensor]) -> None:
    """Applies `change` to the sensor of a set and to those of its tiles; all else stays."""
    index = read_index(Path(folder))
    tiles = [
        tile if tile.sensor is None else dataclasses.replace(tile, sensor=change(tile.sensor))
        for tile in index.tiles
    ]
    write_index(folder, index.gsd_m, tiles, change(index.sensor), index.light)
