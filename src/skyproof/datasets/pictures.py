"""Single pictures that are decoded on demand, whole or window by window."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from skyproof.datasets.annotations import REMEDY
from skyproof.pictures import read_pixels


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
        ...

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Decodes the whole picture, as sRGB bytes."""
        ...

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes once and yields one window after the other, as sRGB bytes."""
        ...


@dataclass(frozen=True, eq=False)
class PictureInMemory:
    """A picture in memory: `[3, H, W]` sRGB bytes."""

    image: UInt8[Tensor, "3 H W"]

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.image.shape[2], self.image.shape[1]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Gives the image itself, not a copy."""
        return self.image

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Yields views of the image."""
        for left, top, width, height in windows:
            yield self.image[:, top : top + height, left : left + width]


@dataclass(frozen=True)
class PictureFile:
    """A picture file of a dataset folder, with the width and height that its annotations state."""

    path: Path
    size_px: tuple[int, int]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Decodes the file.

        Raises:
            StoredFileError: the file is missing, damaged or of another size than stated.
        """
        return tensor_of(read_pixels(self.path, REMEDY, size_px=self.size_px))

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes the file and yields its windows.

        Raises:
            StoredFileError: as `read`.
        """
        return PictureInMemory(self.read()).windows(windows)


def tensor_of(image: Image.Image | UInt8[np.ndarray, "H W 3"]) -> UInt8[Tensor, "3 H W"]:
    """Turns a decoded RGB picture into a tensor of its bytes, channels first, with one copy."""
    return torch.from_numpy(np.array(np.asarray(image).transpose(2, 0, 1), order="C"))
