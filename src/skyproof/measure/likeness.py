"""Photographed and rendered vehicles on the same ground, as each detector sees them."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from skyproof.detectors.detector import Detector
from skyproof.geometry.colour import srgb_to_cielab
from skyproof.measure.baseline import BaselineSet
from skyproof.measure.views import SceneView
from skyproof.ranges import Match
from skyproof.results.likeness import Likeness, Look
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH
from skyproof.results.statistics.intervals import (
    Interval,
    cluster_interval,
    resample,
    share_of,
    superiority_interval,
)
from skyproof.scenes.scene import Scene
from skyproof.seeds import numpy_generator

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of sRGB, from the weights of its linear light
_WHITE = 255
_BORDER_PX = 0.5


@dataclass(frozen=True)
class _Kind:
    """Images of one kind of vehicles, and the name of each one's tile."""

    view: SceneView
    tiles: Sequence[str]

    @cached_property
    def whole(self) -> Sequence[Bool[Tensor, " _n"]]:
        """Which vehicles of each image are whole."""
        return [*map(_is_whole, self.view.images.boxes, self.view.images.sizes_px)]

    @property
    def shown(self) -> set[str]:
        """The tiles that show at least one whole vehicle."""
        return {tile for tile, whole in zip(self.tiles, self.whole, strict=True) if whole.any()}

    def seen(self, detector: Detector, match: Match, numbers: Mapping[str, int]) -> "_Seen":
        """Returns the whole vehicles on numbered tiles, as a detector sees them."""
        matches = self.view.matched(detector.name, match)
        places = zip(matches.image_of_vehicle, matches.index_of_vehicle, strict=True)
        tiles = [
            numbers.get(self.tiles[image], -1) if self.whole[image][index] else -1
            for image, index in places
        ]
        tile = np.array(tiles, dtype=np.int64)
        kept = tile >= 0
        scores = matches.score_of_vehicle[kept].astype(np.float64)
        return _Seen(scores, matches.found_at(detector.threshold)[kept], tile[kept])


@dataclass(frozen=True)
class _Seen:
    """Vehicles on numbered tiles: score (0 for none), found at the threshold, tile's number."""

    scores: Float[np.ndarray, " N"]
    found: Bool[np.ndarray, " N"]
    tile: Int64[np.ndarray, " N"]


def compare_kinds(
    detectors: Sequence[Detector],
    photographs: BaselineSet,
    photographed: SceneView,
    scenes: Sequence[Scene],
    rendered: SceneView,
    *,
    seed: int,
) -> list[Likeness]:
    """Compares labelled vehicles on tiles with rendered ones in scenes on the same tiles.

    Only tiles that show both count; without any, rates are undefined. Empty if the photographs are
    not the tiles of the scenes. The detections are those of both views; no detector runs.
    """
    tiles = [scene.background.tile for scene in scenes]
    if not photographs.real or not set(tiles) & set(photographs.images.ids):
        return []
    kinds = _Kind(photographed, photographs.images.ids), _Kind(rendered, tiles)
    shared = sorted(kinds[0].shown & kinds[1].shown)
    numbers = {tile: number for number, tile in enumerate(shared)}
    looks = [_look(kind, numbers) for kind in kinds]
    weights = resample(max(len(numbers), 1), generator=numpy_generator(seed))
    rows = []
    for detector in detectors:
        for match in (MAIN_MATCH, LENIENT_MATCH):
            first, second = (kind.seen(detector, match, numbers) for kind in kinds)
            higher = superiority_interval(
                first.scores, second.scores, first.tile, second.tile, weights
            )
            rows.append(
                Likeness(
                    detector.name,
                    photographs.name,
                    match,
                    len(numbers),
                    len(first.scores),
                    len(second.scores),
                    *_recalls(first, second, weights),
                    _median(first.scores),
                    _median(second.scores),
                    higher,
                    *looks,
                )
            )
    return rows


def _recalls(
    first: _Seen, second: _Seen, weights: np.ndarray
) -> tuple[Interval, Interval, Interval]:
    """Both recalls, and the first minus the second, with intervals over tiles."""
    count = weights.shape[1]
    counts = np.zeros((2, count, 3), dtype=np.int64)
    for own, kind in zip(counts, (first, second), strict=True):
        own[:, 0] = np.bincount(kind.tile[kind.found], minlength=count)
        own[:, 1] = np.bincount(kind.tile, minlength=count)

    def recall(sums: np.ndarray) -> np.ndarray:
        return share_of(sums[..., 0, 0], sums[..., 0, 1])

    def difference(sums: np.ndarray) -> np.ndarray:
        return np.asarray(recall(sums) - recall(sums[..., 1:, :]))

    first_recall, second_recall = (
        cluster_interval(own[None], recall, weights, limits=(0.0, 1.0)) for own in counts
    )
    between = cluster_interval(counts, difference, weights, limits=(-1.0, 1.0), exact=False)
    return first_recall, second_recall, between


def _median(scores: Float[np.ndarray, " N"]) -> float:
    return float(np.median(scores)) if len(scores) else float("nan")


def _is_whole(boxes: Float[Tensor, "n 4"], size_px: tuple[int, int]) -> Bool[Tensor, " n"]:
    """Returns which vehicles are in sight and touch no border, where only a part is visible."""
    inside = (boxes[:, :2] > _BORDER_PX) & (boxes[:, 2:] < torch.tensor(size_px) - _BORDER_PX)
    return (inside & (boxes[:, 2:] > boxes[:, :2])).all(dim=1)


def _look(kind: _Kind, tiles: Collection[str]) -> Look | None:
    """Measures the look of the whole vehicles on some tiles; None without any."""
    images = kind.view.images
    rows = []
    for index, (tile, whole) in enumerate(zip(kind.tiles, kind.whole, strict=True)):
        if tile not in tiles or not whole.any():
            continue
        # Images of scenes are rendered on demand.
        pixels = images.image(index).cpu().permute(1, 2, 0)
        for left, top, right, bottom in images.boxes[index][whole].tolist():
            across = slice(int(left), math.ceil(right))
            down = slice(int(top), math.ceil(bottom))
            longer_m = max(right - left, bottom - top) * images.gsd_m
            rows.append((*_contents(pixels[down, across].reshape(-1, 3)), longer_m))
    if not rows:
        return None
    dark, bright, white, chroma, length_m = np.array(rows).T
    middles = (float(np.median(values)) for values in (chroma, length_m))
    return Look(float(np.median(dark)), float(np.median(bright)), float(white.mean()), *middles)


def _contents(inside: Tensor) -> tuple[float, float, float, float]:
    """The 2nd and 98th percentile of luminance, the share of white, and the mean chroma."""
    # Rounded, so that white is not more than 255.
    luminance = np.round(inside.double().numpy() @ np.array(_LUMINANCE), 6)
    dark, bright = np.percentile(luminance, (2, 98))
    white = float((inside == _WHITE).all(dim=1).double().mean())
    chroma = srgb_to_cielab(inside.float() / 255)[:, 1:]
    return float(dark), float(bright), white, float(torch.linalg.vector_norm(chroma, dim=1).mean())
