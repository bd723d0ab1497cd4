"""Finds vehicles by a detector, and masks them with their shadows, measured in the pictures."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor
from torchvision import ops

from skyproof.datasets.pictures import Boxes, PictureInMemory, Pixels, window_around
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.inference import detect_in_windows
from skyproof.errors import ConfigurationError

Array = NDArray[np.float64]

DIRECTIONS = 24
LONGEST_SHADOW_M = 6.0
LAYER_M = 0.25
LAYERS = round(LONGEST_SHADOW_M / LAYER_M)
NEAR_M = 1.0
SAMPLE_LIMIT = 300
FEWEST_VEHICLES = 3
FAINTEST_SHADOW = 0.05
"""Smallest difference of brightness between the shadow side and the side across."""
END_SHARE = 0.25
STRETCH, PENUMBRA_M = 1.25, 0.5
"""Factor and addition to the measured length, for higher vehicles and soft edges."""
SAME_VEHICLE_IOU = 0.3


@dataclass(frozen=True)
class Shadow:
    """The shadow that vehicles of one picture cast: its fall, and its reach beyond their boxes.

    The direction is a unit vector (x right, y down), or (0, 0). The contrast is the darkness of the
    shadow side less that of the other, as a share of brightness.
    """

    direction: tuple[float, float]
    length_m: float
    contrast: float
    vehicles: int


def vehicle_mask(
    size_px: tuple[int, ...], boxes: Boxes, shadow: Shadow | None, *, gsd_m: float, margin_m: float
) -> Bool[Tensor, "H W"]:
    """Masks the pixels that boxes touch, grown by a margin and moved along the shadow.

    The margin is doubled if the shadow is unknown (None).
    """
    mask = np.zeros(size_px, dtype=bool)
    margin_px = margin_m / gsd_m * (1 if shadow is not None else 2)
    shadow = shadow or Shadow((0.0, 0.0), 0.0, 0.0, 0)
    length_px = shadow.length_m / gsd_m
    for left, top, right, bottom in boxes.tolist():
        grown = (left - margin_px, top - margin_px, right + margin_px, bottom + margin_px)
        rows, columns = window_around(grown, length_px + 1, size_px)
        if rows.stop > rows.start and columns.stop > columns.start:
            mask[rows, columns] |= arrival(grown, shadow.direction, rows, columns) <= length_px
    return torch.from_numpy(mask)


def darkness_profiles(
    image: Pixels, boxes: Boxes, *, gsd_m: float
) -> Float[Tensor, "n directions layers"]:
    """Measures how dark the ground beside each box is, by direction and by layer outwards.

    A layer is the ground that a box newly covers when it moves by `LAYER_M`. Values are 1 -
    brightness / median brightness within 4 m, cut to [-0.5, 1], or nan without free pixels.
    """
    grey = image.double().mean(0).numpy()
    taken = np.zeros(grey.shape, dtype=bool)
    for box in boxes.tolist():
        rows, columns = window_around(box, 0.0, grey.shape)
        taken[rows, columns] |= arrival(box, (1.0, 0.0), rows, columns) == 0
    profiles = np.full((len(boxes), DIRECTIONS, LAYERS), np.nan)
    for profile, box in zip(profiles, boxes.tolist(), strict=True):
        rows, columns = window_around(box, LONGEST_SHADOW_M / gsd_m, grey.shape)
        free, values = ~taken[rows, columns], grey[rows, columns]
        near = window_around(box, 4 / gsd_m, grey.shape)
        around = grey[near][~taken[near]]
        if around.size < 50:
            continue
        ground = max(float(np.median(around)), 1.0)
        darkness = np.clip(1 - values / ground, -0.5, 1)
        for number in range(DIRECTIONS):
            arrival_m = arrival(box, _unit(number), rows, columns) * gsd_m
            counted = free & (arrival_m > 0) & (arrival_m < LONGEST_SHADOW_M)
            layer = (arrival_m[counted] / LAYER_M).astype(int)
            number_in = np.bincount(layer, minlength=LAYERS)
            sums = np.bincount(layer, weights=darkness[counted], minlength=LAYERS)
            profile[number] = np.where(number_in >= 3, sums / np.maximum(number_in, 1), np.nan)
    return torch.from_numpy(profiles).float()


def estimate_shadow(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> Shadow | None:
    """Estimates the shadow that all vehicles of one picture share; None with fewer than 3 vehicles.

    It has no direction if no side is darker than the one across, as under an overcast sky, or if it
    does not end within 6 m, as that of trees.
    """
    every = [tensor.double().numpy() for tensor in profiles]
    stacked = np.concatenate([np.zeros((0, DIRECTIONS, LAYERS)), *every])
    # Up to 300 vehicles with free ground, `[n, directions, layers]`.
    stacked = stacked[np.isfinite(stacked).any((1, 2))][:SAMPLE_LIMIT]
    if len(stacked) < FEWEST_VEHICLES:
        return None
    # The dark side of boxes, in the median: the sum of all directions, weighted by darkness near.
    layers_near = round(NEAR_M / LAYER_M)
    near = _median_of(stacked[:, :, :layers_near].reshape(len(stacked), -1))
    near = near.reshape(DIRECTIONS, layers_near).mean(1)
    units = np.array([_unit(number) for number in range(DIRECTIONS)])
    x, y = (near[:, None] * units).sum(0).tolist()
    best = round(math.atan2(y, x) / (2 * math.pi) * DIRECTIONS) % DIRECTIONS
    across = (best + DIRECTIONS // 2) % DIRECTIONS
    # Darkness by layer on that side, and near the boxes, both less those of the side across.
    profile = _median_of(stacked[:, best]) - _median_of(stacked[:, across])
    contrast = float(near[best] - near[across])
    peak = int(profile[:layers_near].argmax())
    ends = np.nonzero(profile[peak:] < END_SHARE * profile[peak])[0]
    # A darkness without an end is that of a road's side or of trees along it.
    if contrast < FAINTEST_SHADOW or not len(ends):
        return Shadow((0.0, 0.0), 0.0, contrast, len(stacked))
    reach_m = STRETCH * (peak + int(ends[0])) * LAYER_M + PENUMBRA_M
    direction = (x / math.hypot(x, y), y / math.hypot(x, y))
    return Shadow(direction, min(reach_m, LONGEST_SHADOW_M), contrast, len(stacked))


def _median_of(values: Array) -> Array:
    """Returns the median over the first axis, ignoring nan; 0 if all values are nan."""
    return np.ma.median(np.ma.masked_invalid(values), axis=0).filled(0.0)


def _unit(number: int) -> tuple[float, float]:
    angle = 2 * math.pi * number / DIRECTIONS
    return math.cos(angle), math.sin(angle)


def arrival(
    box: Sequence[float], direction: tuple[float, float], rows: slice, columns: slice
) -> Array:
    """Returns how far a box must move until it covers each pixel centre; infinity if never.

    It is 0 inside.
    """
    left, top, right, bottom = box
    half = ((right - left) / 2, (bottom - top) / 2)
    x = np.arange(columns.start, columns.stop)[None, :] + 0.5 - (left + right) / 2
    y = np.arange(rows.start, rows.stop)[:, None] + 0.5 - (top + bottom) / 2
    first = np.zeros((rows.stop - rows.start, columns.stop - columns.start))
    last = np.full_like(first, np.inf)
    for places, reach, speed in zip((x, y), half, direction, strict=True):
        if abs(speed) < 1e-9:
            outside = abs(places) > reach
            first = np.where(outside, np.inf, first)
            last = np.where(outside, -np.inf, last)
            continue
        first_edge, second_edge = (places - reach) / speed, (places + reach) / speed
        first = np.maximum(first, np.minimum(first_edge, second_edge))
        last = np.minimum(last, np.maximum(first_edge, second_edge))
    return np.where(first <= last, first, np.inf)


@dataclass(frozen=True)
class VehicleFinder:
    """A detector for tiles of any size; its name in the record is its folder and digest."""

    detector: Detector
    name: str
    # Tiles are cleared in several threads, and a detector may not take images of several sizes at
    # a time.
    _alone: Lock = field(default_factory=Lock, repr=False, compare=False)
    _threads: int = field(default_factory=torch.get_num_threads, repr=False, compare=False)

    @classmethod
    def of_folder(cls, detector: Detector, folder: Path, device: torch.device) -> "VehicleFinder":
        """Names a detector by its folder and its weights' digest, and moves it to a device."""
        if not isinstance(detector, TrainableDetector):
            return cls(detector, f"{folder} (by its answers)")
        return cls(detector.to(device), f"{folder} ({detector.weights_sha256[:12]})")

    def detections(self, image: Pixels) -> Boxes:
        """Finds vehicles in a tile of any size, a large one through windows that overlap."""
        with self._alone:
            torch.set_num_threads(self._threads)
            found = detect_in_windows(self.detector, PictureInMemory(image))
        return found.boxes[found.scores >= self.detector.threshold]


def other_vehicles(seen: Boxes, known: Boxes) -> Boxes:
    """Returns the boxes with an IoU below 0.3 with every known vehicle."""
    if not len(known) or not len(seen):
        return seen
    return seen[ops.box_iou(seen, known).max(dim=1).values < SAME_VEHICLE_IOU]


def grown_to_what_is_seen(known: Boxes, seen: Boxes) -> Boxes:
    """Grows known boxes so that they include the detection with the largest IoU, from 0.3 on.

    The square around a point label would leave bumpers. No box shrinks.
    """
    if not len(known) or not len(seen):
        return known
    overlap, nearest = ops.box_iou(known, seen).max(dim=1)
    low = torch.minimum(known[:, :2], seen[nearest, :2])
    high = torch.maximum(known[:, 2:], seen[nearest, 2:])
    grown = torch.cat([low, high], dim=1)
    return torch.where((overlap >= SAME_VEHICLE_IOU)[:, None], grown, known)


def check_resolution(finder: VehicleFinder | None, gsd_m: float) -> None:
    """Refuses a detector that was trained at another resolution."""
    if finder is not None and abs(finder.detector.card.gsd_m - gsd_m) > 0.02 * gsd_m:
        raise ConfigurationError(
            f"The detector {finder.name} was trained at {finder.detector.card.gsd_m} m per pixel "
            f"but the tiles have {gsd_m} m; give one of this resolution, or tile the imagery at "
            "the detector's."
        )
