"""Windows around real and around rendered vehicles, cut alike, for tools/realism.py.

Nothing but the vehicles may tell the two apart. Real images and the ground of the rendered ones
therefore have to be tiles of one `skyproof ground`; here both are copied pixel by pixel, in one
window around the middle of the box, with room on all sides for random shifts that are wider than a
label is off. A window that the image's border cuts is left out, real or not. Windows of ground
without any vehicle are cut too, at the same places of real and rendered images: whoever tells
those apart sees the resampling and not the vehicles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from realism_folds import Drift, drift_of_sources
from realism_images import Shown, read_images
from torch import Tensor

from skyproof.scenes.scene import BackgroundWindow

Item = TypeVar("Item")

CROP_M = 7.0
"""How much a classifier sees across: a car, its shadow and some ground."""

ROOM_M = 0.5
"""How far windows are shifted at random, on both axes: more than boxes drawn by hand are off."""

_ALONE_M = 5.0  # no other vehicle's middle is nearer, so that none reaches far into the window
_SHADOW_M = 4.0  # how far a shadow reaches out of a box where the sun is 25 degrees high


@dataclass(frozen=True, eq=False)
class Crop:
    """A window around a vehicle, or of ground without one.

    Attributes:
        pixels: `[3, S, S]` sRGB bytes; S is the window's side and twice the room for shifts.
        box: left, top, right and bottom of the vehicle in the window's pixels, fractions too; of no
            size, in the middle, where there is none.
        rendered: whether a renderer drew it.
        place: the name that the user gave.
        ground: the place, or the part of it whose positions can be compared.
        position_m: where the window's middle lies on that ground, right and down.
        vehicle: of the fleet; empty where a real one, or none, is shown.
        alone: whether no other vehicle stands close by.
    """

    pixels: Tensor
    box: tuple[float, float, float, float]
    rendered: bool
    place: str
    ground: str
    position_m: tuple[float, float]
    vehicle: str = ""
    alone: bool = True


@dataclass(frozen=True)
class Crops:
    """What can be told apart.

    Attributes:
        vehicles: windows around vehicles, real and rendered.
        empty: windows of ground without a vehicle, in turn of a photograph and of a rendered image
            of the same place; none where those show other ground.
        left_out: how many vehicles the border of their image was too near to.
    """

    vehicles: list[Crop]
    empty: list[Crop]
    left_out: int


def read_crops(
    real: Sequence[str],
    rendered: Sequence[str],
    backgrounds: Sequence[Path],
    classes: Sequence[str],
    *,
    most: int,
    generator: np.random.Generator,
) -> tuple[Crops, float]:
    """Reads real and rendered images and cuts their windows.

    Args:
        real, rendered, backgrounds, classes: as `read_images` takes them.
        most: of each kind of window at most so many, drawn at random.
        generator: draws them.

    Returns:
        The windows, and the metres per pixel of all images.

    Raises:
        SkyproofError: as `read_images` does.
    """
    photographs, renders, gsd_m = read_images(real, rendered, backgrounds, classes)
    drift = _drifts(photographs)
    truth: dict[tuple[str, str], list[Shown]] = {}
    for shown in photographs:
        truth.setdefault((shown.place, shown.source), []).append(shown)

    around = [_around_vehicles(shown, drift, truth, gsd_m) for shown in [*photographs, *renders]]
    empty = [
        pair for shown in renders for pair in _empty_ground(shown, drift, truth, gsd_m, generator)
    ]
    vehicles = [crop for cut, _ in around for crop in cut]
    chosen = [
        _some([crop for crop in vehicles if crop.rendered == wanted], most, generator)
        for wanted in (False, True)
    ]
    twins = _some(empty, most, generator)
    return (
        Crops(
            vehicles=chosen[0] + chosen[1],
            empty=[crop for pair in twins for crop in pair],
            left_out=sum(missed for _, missed in around),
        ),
        gsd_m,
    )


def _some(items: list[Item], most: int, generator: np.random.Generator) -> list[Item]:
    """Returns at most so many, drawn at random, in their order."""
    return [items[index] for index in sorted(generator.permutation(len(items))[:most])]


def side_px(gsd_m: float) -> tuple[int, int]:
    """Returns the side of the window that a classifier sees and the room around it, in pixels."""
    return 2 * round(CROP_M / gsd_m / 2), round(ROOM_M / gsd_m)


def _drifts(photographs: Sequence[Shown]) -> dict[tuple[str, str], Drift]:
    """Finds out, place by place, how far its photographs are shifted against each other."""
    found: dict[tuple[str, str], Drift] = {}
    for place in dict.fromkeys(shown.place for shown in photographs):
        own = [shown for shown in photographs if shown.place == place]
        # Sources on one grid share no tile; photographs with grids of their own all begin alike.
        alike = {shown.source: shown for shown in own if shown.offset_px == own[0].offset_px}
        grey = {name: shown.pixels.float().mean(0).numpy() for name, shown in alike.items()}
        drift = drift_of_sources(place, grey)
        for shown in own:
            found[place, shown.source] = drift.get(shown.source, Drift(place, (0.0, 0.0)))
    return found


def _around_vehicles(
    shown: Shown,
    drift: dict[tuple[str, str], Drift],
    truth: dict[tuple[str, str], list[Shown]],
    gsd_m: float,
) -> tuple[list[Crop], int]:
    boxes = shown.boxes.numpy().astype(np.float64)
    middles = (boxes[:, :2] + boxes[:, 2:]) / 2
    others = np.concatenate([boxes, shown.others.numpy()])
    between = np.linalg.norm(middles[:, None] - (others[:, :2] + others[:, 2:])[None] / 2, axis=2)
    between[np.arange(len(boxes)), np.arange(len(boxes))] = np.inf
    # Where no real vehicle is looked at, no rendered one is either.
    spared = _distances(shown, middles, truth, regions=True) <= 0
    crops = []
    missed = 0
    for index, (box, middle) in enumerate(zip(boxes, middles, strict=True)):
        if spared[index]:
            continue
        crop = _cut(shown, middle, drift, gsd_m)
        if crop is None:
            missed += 1
            continue
        corner = np.floor(middle) - crop.pixels.shape[1] // 2
        inner = box - np.tile(corner, 2)
        crops.append(
            _in_tile_orientation(
                replace(
                    crop,
                    box=(float(inner[0]), float(inner[1]), float(inner[2]), float(inner[3])),
                    vehicle=shown.vehicles[index] if shown.rendered else "",
                    alone=bool(between[index].min(initial=np.inf) * gsd_m >= _ALONE_M),
                ),
                shown.window,
            )
        )
    return crops, missed


def _empty_ground(
    shown: Shown,
    drift: dict[tuple[str, str], Drift],
    truth: dict[tuple[str, str], list[Shown]],
    gsd_m: float,
    generator: np.random.Generator,
) -> list[tuple[Crop, Crop]]:
    """Cuts windows that show no vehicle, no shadow of one, and nothing that was filled.

    Args:
        shown: a rendered image.
        drift, truth: of all photographs.
        gsd_m: metres per pixel.
        generator: draws the places.

    Returns:
        Windows of the photograph and of the rendered image, of the same places.
    """
    side, room = side_px(gsd_m)
    # Of a window only a disc is shown, shifted by the room.
    reach_px = side / 2 + room * math.sqrt(2) + _SHADOW_M / gsd_m
    size = shown.pixels.shape[1]
    middles = generator.uniform(0, size, (60, 2))
    free = middles[_distances(shown, middles, truth) > reach_px]
    pairs = []
    for middle, there in zip(free, shown.in_source(free), strict=True):
        own = _cut(shown, middle, drift, gsd_m)
        for photograph in truth.get((shown.place, shown.source), []):
            twin = _cut(photograph, there - np.array(photograph.offset_px), drift, gsd_m)
            if own is not None and twin is not None:
                pairs.append((twin, _in_tile_orientation(own, shown.window)))
    return pairs


def _distances(
    shown: Shown,
    middles: NDArray[np.float64],
    truth: dict[tuple[str, str], list[Shown]],
    *,
    regions: bool = False,
) -> NDArray[np.float64]:
    """Says how far points are from the nearest vehicle, shown or removed, in pixels; 0 inside.

    Args:
        shown: the image.
        middles: `[n, 2]` points in it.
        truth: the photographs that the ground is cut from.
        regions: measure to the regions of the photographs where nothing is scored, and not to
            vehicles.
    """
    nearest = np.full(len(middles), np.inf)
    if not regions:
        nearest = np.minimum(nearest, _to_boxes(middles, shown.boxes.numpy()))
    there = shown.in_source(middles)
    for photograph in truth.get((shown.place, shown.source), []):
        kinds = [photograph.others] if regions else [photograph.others, photograph.boxes]
        boxes = torch.cat(kinds).numpy() + np.tile(np.array(photograph.offset_px), 2)
        nearest = np.minimum(nearest, _to_boxes(there, boxes))
    return nearest


def _to_boxes(points: NDArray[np.float64], boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(boxes):
        return np.full(len(points), np.inf)
    outside = np.maximum(boxes[None, :, :2] - points[:, None], points[:, None] - boxes[None, :, 2:])
    nearest: NDArray[np.float64] = np.linalg.norm(np.maximum(outside, 0), axis=2).min(1)
    return nearest


def _cut(
    shown: Shown,
    middle: NDArray[np.float64],
    drift: dict[tuple[str, str], Drift],
    gsd_m: float,
) -> Crop | None:
    """Copies the window around a point, or returns None where the image's border cuts it."""
    side, room = side_px(gsd_m)
    half = side // 2 + room
    left, top = (int(value) - half for value in middle)
    height, width = shown.pixels.shape[1:]
    if left < 0 or top < 0 or left + 2 * half > width or top + 2 * half > height:
        return None
    own = drift.get((shown.place, shown.source), Drift(f"{shown.place}/{shown.source}", (0.0, 0.0)))
    x, y = (shown.in_source(middle[None])[0] + np.array(own.shift_px)) * gsd_m
    return Crop(
        pixels=shown.pixels[:, top : top + 2 * half, left : left + 2 * half].clone(),
        box=(half, half, half, half),
        rendered=shown.rendered,
        place=shown.place,
        ground=own.ground,
        position_m=(float(x), float(y)),
    )


def _in_tile_orientation(crop: Crop, window: BackgroundWindow | None) -> Crop:
    """Turns a window of a window that was turned by quarters back, so that pairs lie alike."""
    quarters = 0 if window is None else round(window.rotation_rad / (math.pi / 2))
    if window is None or window.rotation_rad != quarters * math.pi / 2:
        return crop
    size = crop.pixels.shape[1]
    left, top, right, bottom = crop.box
    # The picture was turned right by so many quarters; it is turned left again.
    for _ in range(quarters % 4):
        left, top, right, bottom = top, size - right, bottom, size - left
    return replace(
        crop,
        pixels=crop.pixels.rot90(quarters, (1, 2)).contiguous(),
        box=(left, top, right, bottom),
    )
