"""Background sets: folders of ground tiles at one resolution, in splits, read through windows."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.pictures import read_pixels
from skyproof.scenes.background_index import REMEDY, BackgroundTile, MapKind, read_index
from skyproof.scenes.light import Light
from skyproof.scenes.places import DIRECTIONS
from skyproof.scenes.scene import BackgroundWindow
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS

CACHE_BYTES = 256 * 2**20


class BackgroundSet:
    """A folder `index.json` + `tiles/*.png`; decoded tiles are kept while memory allows."""

    def __init__(
        self,
        folder: Path,
        gsd_m: float,
        tiles: Sequence[BackgroundTile],
        sensor: Sensor | None = None,
        light: Light | None = None,
    ) -> None:
        self.folder = folder
        self.gsd_m = gsd_m
        self.sensor = sensor or Sensor()
        self.light = light or Light()
        self._tiles = {tile.id: tile for tile in tiles}
        self._decoded: OrderedDict[str, UInt8[Tensor, ...]] = OrderedDict()
        # Several threads may read one set.
        self._decoding = Lock()

    @classmethod
    def open(cls, folder: str | Path) -> "BackgroundSet":
        """Opens a set that `write_procedural_backgrounds` or `tile_imagery` wrote."""
        folder = Path(folder)
        index = read_index(folder)
        return cls(folder, index.gsd_m, index.tiles, index.sensor, index.light)

    def tiles(self, split: str) -> list[BackgroundTile]:
        """The tiles of one split, in the order of the index."""
        return [tile for tile in self._tiles.values() if tile.split == split]

    def all_tiles(self) -> list[BackgroundTile]:
        """The tiles of all splits, one split after the other."""
        return [tile for split in SPLITS for tile in self.tiles(split)]

    def tile(self, tile_id: str) -> BackgroundTile:
        """Returns the tile with this id; raises StoredFileError if there is none."""
        if tile_id not in self._tiles:
            raise StoredFileError(
                f"{self.folder} has no tile {tile_id!r}; give the background set that the scenes "
                "were sampled on."
            )
        return self._tiles[tile_id]

    def sensor_of(self, window: BackgroundWindow) -> Sensor:
        """The sensor of a window's photograph."""
        return self.tile(window.tile).sensor or self.sensor

    def light_of(self, window: BackgroundWindow) -> Light:
        """The light of a window's photograph; its sun is in the tile's axes, not the window's."""
        return self.tile(window.tile).light or self.light

    def pixels(self, tile_id: str) -> UInt8[Tensor, "3 H W"]:
        """Returns a tile in sRGB bytes; StoredFileError if its file is missing or damaged."""
        tile = self.tile(tile_id)
        return self._kept(tile, tile.file)

    def directions(self, tile_id: str) -> UInt8[Tensor, "H W"] | None:
        """Returns a tile's map of drivable ground (`skyproof.scenes.directions`), if it has one."""
        directions = self.map_of(tile_id, "drivable")
        if directions is not None and int(directions.max()) > DIRECTIONS:
            raise StoredFileError(
                f"{self.folder}/{self.tile(tile_id).drivable} holds values above {DIRECTIONS}, so "
                f"it is no map of drivable ground; {REMEDY}."
            )
        return directions

    def map_of(self, tile_id: str, kind: MapKind) -> UInt8[Tensor, "H W"] | None:
        """Returns one of a tile's maps (see `BackgroundTile`), if it has it."""
        tile = self.tile(tile_id)
        file = getattr(tile, kind)
        return None if file is None else self._kept(tile, file)

    def _kept(self, tile: BackgroundTile, file: str) -> Tensor:
        """Decodes a tile's picture `[3, H, W]`, or map `[H, W]`, and keeps it if memory allows."""
        with self._decoding:
            if file not in self._decoded:
                size_px = tile.width_px, tile.height_px
                array = read_pixels(self.folder / file, REMEDY, size_px=size_px)
                picture = torch.from_numpy(array).permute(2, 0, 1).contiguous()
                self._decoded[file] = picture if file == tile.file else picture[0].clone()
            self._decoded.move_to_end(file)
            pixels = self._decoded[file]
            kept = self._decoded.values()
            # The requested file is the last one, and stays.
            while len(kept) > 1 and sum(each.numel() for each in kept) > CACHE_BYTES:
                self._decoded.popitem(last=False)
        return pixels

    def window(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "3 size_px size_px"]:
        """Cuts a square window, sRGB in [0, 1]: an exact copy on whole pixels, else bilinear.

        A window that extends beyond its tile raises StoredFileError.
        """
        return self._cut(self.pixels(window.tile), window, size_px)

    def cover_of(
        self, window: BackgroundWindow, size_px: int
    ) -> Float[Tensor, "size_px size_px"] | None:
        """Cuts the map of cover, in [0, 1], as `window` cuts the photograph; None without a map."""
        cover = self.map_of(window.tile, "cover")
        return None if cover is None else self._cut(cover[None], window, size_px)[0]

    def _cut(
        self, pixels: UInt8[Tensor, "C H W"], window: BackgroundWindow, size_px: int
    ) -> Float[Tensor, "C size_px size_px"]:
        half = size_px / 2
        cosine, sine = math.cos(window.rotation_rad), math.sin(window.rotation_rad)
        reach = half * (abs(cosine) + abs(sine))
        left, top = window.centre_x_px - reach, window.centre_y_px - reach
        right, bottom = window.centre_x_px + reach, window.centre_y_px + reach
        if min(left, top) < -0.5 or right > pixels.shape[2] + 0.5 or bottom > pixels.shape[1] + 0.5:
            raise StoredFileError(
                f"{self.folder} has a tile {window.tile} of {pixels.shape[2]} x {pixels.shape[1]} "
                f"px, and a window of {size_px} px reaches out of it; give the background set that "
                "the scenes were sampled on."
            )
        quarters = round(window.rotation_rad / (math.pi / 2))
        corner_x, corner_y = window.centre_x_px - half, window.centre_y_px - half
        whole = corner_x.is_integer() and corner_y.is_integer()
        if whole and window.rotation_rad == quarters * math.pi / 2:
            x0, y0 = int(corner_x), int(corner_y)
            copied = pixels[:, y0 : y0 + size_px, x0 : x0 + size_px]
            # The camera turns left, so the picture turns right.
            return torch.rot90(copied, -quarters, (1, 2)).float() / 255
        x0, y0 = max(0, math.floor(left) - 1), max(0, math.floor(top) - 1)
        crop = pixels[:, y0 : math.ceil(bottom) + 1, x0 : math.ceil(right) + 1].float()
        # Rows run down the screen: a counter-clockwise turn takes right (1, 0) to (cos, -sin) and
        # down to (sin, cos).
        steps = torch.arange(size_px, dtype=torch.float64) + 0.5 - half
        per_x, per_y = 2 / crop.shape[2], 2 / crop.shape[1]
        across_x, across_y = cosine * steps * per_x, -sine * steps * per_y
        down_x = (window.centre_x_px - x0 + sine * steps) * per_x - 1
        down_y = (window.centre_y_px - y0 + cosine * steps) * per_y - 1
        grid = torch.empty(1, size_px, size_px, 2)
        torch.add(across_x.float()[None, :], down_x.float()[:, None], out=grid[0, ..., 0])
        torch.add(across_y.float()[None, :], down_y.float()[:, None], out=grid[0, ..., 1])
        sampled = F.grid_sample(
            crop[None], grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        return sampled[0].div_(255)

    def sample_pixels(
        self, split: str, per_tile: int, *, generator: torch.Generator
    ) -> Float[Tensor, "P 3"]:
        """Draws the same number of pixels from each tile of a split, sRGB in [0, 1]."""
        drawn = []
        for tile in self.tiles(split):
            flat = self.pixels(tile.id).flatten(1)
            drawn.append(flat[:, torch.randint(flat.shape[1], (per_tile,), generator=generator)].T)
        return torch.cat(drawn).float() / 255 if drawn else torch.zeros(0, 3)

    def sample_window(
        self, split: str, size_px: int, *, generator: torch.Generator
    ) -> BackgroundWindow:
        """Draws a tile of the split uniformly, and a window that lies fully inside it."""
        tiles = self.window_tiles(split, size_px)
        tile = tiles[int(torch.randint(len(tiles), (1,), generator=generator))]
        return self.sample_window_on(tile, size_px, generator=generator)

    def window_tiles(self, split: str, size_px: int) -> list[BackgroundTile]:
        """The tiles of a split that are large enough for windows."""
        tiles = self.tiles(split)
        fitting = [tile for tile in tiles if min(tile.width_px, tile.height_px) >= size_px]
        if not fitting:
            raise ConfigurationError(
                f"{self.folder} has no {split} tile of at least {size_px} px, as a window of that "
                "size needs; choose a smaller image or cut larger tiles."
            )
        return fitting

    def sample_window_on(
        self, tile: BackgroundTile, size_px: int, *, generator: torch.Generator
    ) -> BackgroundWindow:
        """Draws a place on a tile, and a rotation at which the window fits there.

        If there is no room to turn, the rotation is in quarter turns and the place on whole pixels.
        """
        turn, x, y = torch.rand(3, dtype=torch.float64, generator=generator).tolist()
        room_rad = room_to_turn_rad(size_px, min(tile.width_px, tile.height_px))
        if not room_rad:
            left_px = math.floor(x * (tile.width_px - size_px + 1))
            top_px = math.floor(y * (tile.height_px - size_px + 1))
            middle_px = size_px / 2 + left_px, size_px / 2 + top_px
            return BackgroundWindow(tile.id, *middle_px, math.floor(4 * turn) * math.pi / 2)
        rotation_rad = 2 * math.pi * turn
        if room_rad < math.pi / 4:
            quarters, within = divmod(4 * turn, 1)
            rotation_rad = (quarters * math.pi / 2 + (2 * within - 1) * room_rad) % (2 * math.pi)
        reach = size_px / 2 * (abs(math.cos(rotation_rad)) + abs(math.sin(rotation_rad)))
        x_px = reach + x * (tile.width_px - 2 * reach)
        y_px = reach + y * (tile.height_px - 2 * reach)
        return BackgroundWindow(tile.id, x_px, y_px, rotation_rad)


def read_map(
    values: UInt8[Tensor, "H W"],
    window: BackgroundWindow,
    east_px: Float[Tensor, " P"],
    north_px: Float[Tensor, " P"],
) -> UInt8[Tensor, " P"]:
    """Reads a map of a window's tile at points given in pixels from the middle of a scene."""
    cosine, sine = math.cos(window.rotation_rad), math.sin(window.rotation_rad)
    column = window.centre_x_px + cosine * east_px - sine * north_px
    row = window.centre_y_px - sine * east_px - cosine * north_px
    return values[
        row.floor().long().clamp(0, values.shape[0] - 1),
        column.floor().long().clamp(0, values.shape[1] - 1),
    ]


def room_to_turn_rad(size_px: int, side_px: int) -> float:
    """Returns how far a window can turn either way from the sides of a square tile that holds it.

    The angle is 0 if there is no room, and pi / 4 if every rotation fits. A window that is turned
    by a <= pi / 4 spans size (cos a + sin a) = size sqrt(2) cos(pi / 4 - a) pixels.
    """
    if side_px <= size_px:
        return 0.0
    if side_px >= math.ceil(size_px * math.sqrt(2)):
        return math.pi / 4
    return math.pi / 4 - math.acos(side_px / (size_px * math.sqrt(2)))
