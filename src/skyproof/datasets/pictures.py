"""Single pictures that are decoded when somebody looks at them, whole or window by window."""

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
    """One image of a dataset, wherever its pixels are kept."""

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
    """A picture whose pixels are at hand.

    Attributes:
        image: `[3, H, W]` sRGB bytes.
    """

    image: UInt8[Tensor, "3 H W"]

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.image.shape[2], self.image.shape[1]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Gives the image as it is, not a copy."""
        return self.image

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Yields views of the image."""
        for left, top, width, height in windows:
            yield self.image[:, top : top + height, left : left + width]


@dataclass(frozen=True)
class PictureFile:
    """A picture of a dataset folder.

    Attributes:
        path: of the image file.
        size_px: width and height, as the annotations say.
    """

    path: Path
    size_px: tuple[int, int]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Decodes the file.

        Raises:
            StoredFileError: the file is missing, damaged or of another size than was stated.
        """
        return tensor_of(read_pixels(self.path, REMEDY, size_px=self.size_px))

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes the file and yields its windows.

        Raises:
            StoredFileError: the file is missing, damaged or of another size than was stated.
        """
        return PictureInMemory(self.read()).windows(windows)


def tensor_of(image: Image.Image | UInt8[np.ndarray, "H W 3"]) -> UInt8[Tensor, "3 H W"]:
    """Turns a decoded RGB picture into a tensor of its bytes, channels first, by one copy."""
    return torch.from_numpy(np.array(np.asarray(image).transpose(2, 0, 1), order="C"))
