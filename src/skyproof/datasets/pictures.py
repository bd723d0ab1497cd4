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

from skyproof.errors import StoredFileError

__all__ = ["Picture", "PictureFile", "PictureInMemory", "Window", "tensor_of"]


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
        try:
            with Image.open(self.path) as image:
                pixels = tensor_of(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError) as error:
            raise StoredFileError(
                f"{self.path} cannot be read ({error}); write the dataset again."
            ) from error
        height, width = pixels.shape[1:]
        if (width, height) != self.size_px:
            raise StoredFileError(
                f"{self.path} has {width} x {height} px but annotations.json says "
                f"{self.size_px[0]} x {self.size_px[1]}; write the dataset again."
            )
        return pixels

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes the file and yields its windows.

        Raises:
            StoredFileError: the file is missing, damaged or of another size than was stated.
        """
        return PictureInMemory(self.read()).windows(windows)


def tensor_of(image: Image.Image) -> UInt8[Tensor, "3 H W"]:
    """Turns a decoded RGB picture into a tensor of its bytes, channels first."""
    return torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous()
