"""Runs detectors over many images, and over large images window by window."""

import itertools
import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torchvision import ops

from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import Picture, Window, made_ahead
from skyproof.detectors.detector import SUPPRESSION_IOU, WINDOW_PX, Detections, Detector

LARGEST_WHOLE_PX = 1024
"""Images with a longer side are split into windows."""

_STRIDE_PX = 32
"""Networks pad images to a multiple of it."""

# Windows overlap by a quarter of their side: the length of two cars in windows of 48 m.
_OVERLAP_SHARE = 4
# Two windows place the same vehicle less than this apart.
_SEAM_PX = 8
_BATCH_SIZE = 16
# A large image leaves less memory.
_WINDOW_BATCH_SIZE = 8


def detect_all(detector: Detector, dataset: Dataset) -> list[Detections]:
    """Returns one detector's detections in every image, as `detect_by_each` does for several."""
    return detect_by_each([detector], dataset)[0]


def detect_by_each(detectors: Sequence[Detector], dataset: Dataset) -> list[list[Detections]]:
    """Returns each detector's detections in every image, in image pixels, by falling score.

    Images are decoded batch by batch, once for all detectors. An image of more than 1024 px a side,
    or beyond the window of a detector that sees windows alone, is split into windows no larger than
    the detector's, which overlap by a quarter; the window whose core holds a detection's centre
    keeps it, and duplicates at the seams are suppressed. So neither memory nor a largest number of
    detections limits the result on a large image.
    """
    sizes = dataset.sizes_px
    results: list[list[Detections]] = [[] for _ in detectors]

    def decode(batch: Sequence[int]) -> list[Tensor]:
        # Large images are decoded window by window, when their turn comes.
        return [] if max(sizes[batch[0]]) > LARGEST_WHOLE_PX else dataset.images(batch)

    batches = list(_batches(sizes))
    for batch, images in zip(batches, made_ahead(decode, batches), strict=True):
        shown = torch.stack(images) if images else None
        for found, detector in zip(results, detectors, strict=True):
            beyond = detector.in_windows_alone and max(sizes[batch[0]]) > detector.window_px
            if shown is not None and not beyond:
                found += detector.detect(to_detector(detector, shown))
            else:
                found += [detect_in_windows(detector, dataset.pictures[each]) for each in batch]
    return results


def to_detector(detector: object, images: UInt8[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Moves sRGB bytes to a detector's own device, as numbers in [0, 1]."""
    batch = images.to(device_of(detector)).float() / 255
    return batch.contiguous(memory_format=torch.channels_last)


def device_of(thing: object) -> torch.device:
    """The device of a network or a camouflage; the CPU for anything else."""
    if not isinstance(thing, nn.Module):
        return torch.device("cpu")
    first = next(itertools.chain(thing.parameters(), thing.buffers()), None)
    return torch.device("cpu") if first is None else first.device


def covering_windows(size_px: tuple[int, int], window_px: int = WINDOW_PX) -> list[Window]:
    """Covers a picture with equal windows, row by row; a side shorter than a window needs one."""
    lefts, width = _starts(size_px[0], window_px)
    tops, height = _starts(size_px[1], window_px)
    return [Window(left, top, width, height) for top in tops for left in lefts]


def _starts(side_px: int, window_px: int) -> tuple[list[int], int]:
    """Returns the starts of the fewest windows that cover a side, and their smallest length."""
    if side_px <= window_px:
        return [0], side_px
    overlap_px = window_px // _OVERLAP_SHARE
    count = math.ceil((side_px - overlap_px) / (window_px - overlap_px))
    length = math.ceil((side_px + (count - 1) * overlap_px) / count / _STRIDE_PX) * _STRIDE_PX
    step = (side_px - length) / (count - 1)
    return [round(index * step) for index in range(count)], length


def _batches(sizes_px: Sequence[tuple[int, int]]) -> Iterator[list[int]]:
    """Yields batches of indices of consecutive images of one size; a large image is alone."""
    for size, group in itertools.groupby(range(len(sizes_px)), key=lambda index: sizes_px[index]):
        at_once = 1 if max(size) > LARGEST_WHOLE_PX else _BATCH_SIZE
        while part := list(itertools.islice(group, at_once)):
            yield part


def detect_in_windows(detector: Detector, picture: Picture) -> Detections:
    """Runs a detector over a picture window by window, and merges the detections."""
    windows = covering_windows(picture.size_px, detector.window_px)
    at_once = max(1, _WINDOW_BATCH_SIZE * WINDOW_PX**2 // detector.window_px**2)
    around = zip(windows, cores(windows), strict=True)
    views = picture.windows(windows)
    boxes: list[Tensor] = []
    scores: list[Tensor] = []
    while images := list(itertools.islice(views, at_once)):
        answers = detector.detect(to_detector(detector, torch.stack(images)))
        for found, (window, core) in zip(
            answers, itertools.islice(around, len(images)), strict=True
        ):
            placed, kept = moved(found.boxes.cpu(), window, core)
            boxes.append(placed[kept])
            scores.append(found.scores.cpu()[kept])
    all_boxes = torch.cat(boxes)
    all_scores = torch.cat(scores)
    # This sorts by falling score, too.
    order = ops.nms(all_boxes, all_scores, SUPPRESSION_IOU)
    return Detections(all_boxes[order], all_scores[order])


def moved(boxes: Tensor, window: Window, core: Tensor) -> tuple[Tensor, Tensor]:
    """Moves boxes of a window into its picture; also says which have their centre in the core."""
    placed = boxes + torch.tensor([window.left, window.top] * 2, dtype=torch.float32)
    centres = (placed[:, :2] + placed[:, 2:]) / 2
    return placed, ((centres >= core[:2]) & (centres < core[2:])).all(dim=1)


def cores(windows: Sequence[Window]) -> Float[Tensor, "W 4"]:
    """Returns each window's core: to just beyond the middle of overlaps, open at the border."""
    edges = []
    for axis in (0, 1):
        length = windows[0][2 + axis]
        starts = sorted({window[axis] for window in windows})
        middles = [(second + first + length) / 2 for first, second in itertools.pairwise(starts)]
        lows = [-torch.inf, *(middle - _SEAM_PX for middle in middles)]
        highs = [*(middle + _SEAM_PX for middle in middles), torch.inf]
        edges += [dict(zip(starts, each, strict=True)) for each in (lows, highs)]
    lefts, rights, tops, bottoms = edges
    return torch.tensor(
        [[lefts[left], tops[top], rights[left], bottoms[top]] for left, top, _, _ in windows]
    )
