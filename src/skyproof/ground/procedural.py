"""Procedural aerial pictures of ground without vehicles, and background sets of them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.ground.built_up import draw_car_park, draw_crossroads, draw_street, draw_yard
from skyproof.ground.canvas import Canvas
from skyproof.ground.open_country import draw_fields, draw_park, draw_village
from skyproof.ground.photograph import GroundSensor, photograph
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS

GROUND_KINDS: dict[str, tuple[Callable[[Canvas], None], float]] = {
    "car park": (draw_car_park, 0.2),
    "crossroads": (draw_crossroads, 0.15),
    "fields": (draw_fields, 0.08),
    "park": (draw_park, 0.08),
    "street": (draw_street, 0.2),
    "village": (draw_village, 0.14),
    "yard": (draw_yard, 0.15),
}
"""The kinds of ground and their shares, larger for kinds with vehicles or things like them."""


@dataclass(frozen=True)
class DrawnGround:
    """A drawn tile `[3, H, W]` with its light and sensor, and maps as in `BackgroundTile`."""

    image: UInt8[Tensor, "3 H W"]
    kind: str
    light: Light
    sensor: Sensor
    directions: UInt8[np.ndarray, "H W"]
    shade: UInt8[np.ndarray, "H W"]
    cover: UInt8[np.ndarray, "H W"]


def draw_ground(size_px: int, gsd_m: float, *, generator: torch.Generator) -> DrawnGround:
    """Draws a tile of a random kind, `[3, size_px, size_px]`, with one draw of the generator.

    Everything is drawn as reflectance and height. One sun lights it, shadows follow from the
    heights, and a random sensor photographs it (haze, tint, blur, noise). There are no vehicles,
    but many things of a vehicle's size. The map of drivable ground allows vehicles in lanes, along
    kerbs, in bays, drives and yards, and on tracks, and none in a park.
    """
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    kind = str(rng.choice(list(GROUND_KINDS), p=[share for _, share in GROUND_KINDS.values()]))
    canvas = Canvas(size_px, gsd_m, rng, axes_rad=rng.uniform(0, 2 * math.pi))
    GROUND_KINDS[kind][0](canvas)
    canvas.mute(rng.uniform(0.35, 1.0))
    camera = GroundSensor.draw(rng)
    picture = photograph(canvas, camera)
    return DrawnGround(
        torch.from_numpy(picture.image),
        kind,
        picture.light,
        Sensor(round(camera.blur_px, 3), round(camera.noise, 5)),
        canvas.drivable(),
        picture.shade,
        canvas.cover(camera.blur_px),
    )


def write_procedural_backgrounds(
    folder: Path,
    counts: Mapping[str, int],
    size_px: int,
    *,
    seed: int,
    gsd_m: float = 0.125,
    progress: Callable[[int, int], None] | None = None,
) -> BackgroundSet:
    """Draws a background set of so many tiles per split, each with its sensor.

    Each tile has a seed of its own, so that its bytes do not depend on the number of tiles.
    `progress` is called with (tiles done, tiles in all). Use `finished_folder` around it.

    Raises:
        ConfigurationError: a split has another name.
        RunFolderError: the disk cannot take it.
    """
    unknown = set(counts) - set(SPLITS)
    if unknown:
        raise ConfigurationError(
            f"Unknown split {sorted(unknown)[0]!r}; the splits are {', '.join(SPLITS)}."
        )
    total = sum(counts.values())
    tiles = []
    for split in SPLITS:
        for number in range(counts.get(split, 0)):
            state = np.random.SeedSequence(
                [seed % 2**64, SPLITS.index(split), number]
            ).generate_state(1, np.uint64)
            generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
            ground = draw_ground(size_px, gsd_m, generator=generator)
            tile_id = f"{split}-{number:05d}"
            tile = BackgroundTile(
                id=tile_id,
                file=f"tiles/{tile_id}.png",
                split=split,
                width_px=size_px,
                height_px=size_px,
                source="procedural",
                kind=ground.kind,
                sensor=ground.sensor,
                light=ground.light,
                drivable=save_map(folder, "drivable", tile_id, ground.directions),
                shade=save_map(folder, "shade", tile_id, ground.shade),
                cover=save_map(folder, "cover", tile_id, ground.cover),
            )
            save_tile(folder, tile, ground.image)
            tiles.append(tile)
            if progress is not None:
                progress(len(tiles), total)
    write_index(folder, gsd_m, tiles)
    return BackgroundSet.open(folder)
