"""Single pictures that are decoded on demand, and items made ahead in a thread."""

import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from skyproof.pictures import read_pixels

REMEDY = "copy the whole folder again, or make the dataset again"
Pixels = UInt8[Tensor, "3 H W"]
"""A picture of sRGB bytes."""
Boxes = Float[Tensor, "_n 4"]
"""Boxes in pixels, xyxy and half-open."""


class Window(NamedTuple):
    """A rectangle of whole pixels in a picture."""

    left: int
    top: int
    width: int
    height: int


@runtime_checkable
class Picture(Protocol):
    """One image of a dataset, in memory or in a file."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, known without decoding."""

    def read(self) -> Pixels:
        """Decodes the whole picture, as sRGB bytes."""

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes once and yields one window after the other, as sRGB bytes."""


@dataclass(frozen=True, eq=False)
class PictureInMemory:
    """A picture in memory: `[3, H, W]` sRGB bytes."""

    image: Pixels

    @property
    def size_px(self) -> tuple[int, int]:
        return self.image.shape[2], self.image.shape[1]

    def read(self) -> Pixels:
        return self.image

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        for left, top, width, height in windows:
            yield self.image[:, top : top + height, left : left + width]


@dataclass(frozen=True)
class PictureFile:
    """A picture file of a dataset folder, with the width and height that its annotations state."""

    path: Path
    size_px: tuple[int, int]

    def read(self) -> Pixels:
        return tensor_of(read_pixels(self.path, REMEDY, size_px=self.size_px))

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        return PictureInMemory(self.read()).windows(windows)


def window_around(
    box: Sequence[float], margin_px: float, size_px: tuple[int, ...]
) -> tuple[slice, slice]:
    """Returns the rows and columns around a box, xyxy, as far as a picture `[H, W]` has them."""
    left, top, right, bottom = box
    rows, columns = (
        slice(max(0, math.floor(low - margin_px)), max(0, min(size, math.ceil(high + margin_px))))
        for low, high, size in ((top, bottom, size_px[0]), (left, right, size_px[1]))
    )
    return rows, columns


def tensor_of(image: Image.Image | UInt8[np.ndarray, "H W 3"]) -> Pixels:
    """Turns a decoded RGB picture into a tensor of its bytes, channels first, with one copy."""
    return torch.from_numpy(np.array(np.asarray(image).transpose(2, 0, 1), order="C"))


Item = TypeVar("Item")
Made = TypeVar("Made")


def made_ahead(
    make: Callable[[Item], Made],
    items: Iterable[Item],
    threads: int = 1,
    start: Callable[[], object] | None = None,
) -> Generator[Made, None, None]:
    """Yields `make(item)` for each item in order, while threads make the next ones.

    At most one result per thread is kept in advance. `start` is called in each thread at first. An
    error of `make` is raised in place of its result.
    """
    maker = ThreadPoolExecutor(threads, "ahead", start)
    waiting: deque[Future[Made]] = deque()
    try:
        for item in items:
            waiting.append(maker.submit(make, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        maker.shutdown(cancel_futures=True)
