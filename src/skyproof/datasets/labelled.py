"""Images with known vehicles: what detectors train on and are checked against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor

__all__ = ["LabelledImages", "join"]


@dataclass(frozen=True)
class LabelledImages:
    """Images in memory with the boxes of every vehicle in them.

    Attributes:
        images: per image `[3, H, W]` sRGB bytes; sizes may differ.
        boxes: per image `[n, 4]` true vehicles, pixel xyxy.
        ignore: per image `[m, 4]` regions where nothing is scored: other vehicle classes, unlabelled borders (PAPER 1).
        ids: per image its name.
        gsd_m: metres per pixel.
    """

    images: Sequence[UInt8[Tensor, "3 _H _W"]]
    boxes: Sequence[Float[Tensor, "_n 4"]]
    ignore: Sequence[Float[Tensor, "_m 4"]]
    ids: Sequence[str]
    gsd_m: float

    def __len__(self) -> int:
        return len(self.images)


def join(parts: Sequence[LabelledImages]) -> LabelledImages:
    """Several sets of one resolution as one, in their order."""
    return LabelledImages(
        images=[image for part in parts for image in part.images],
        boxes=[boxes for part in parts for boxes in part.boxes],
        ignore=[regions for part in parts for regions in part.ignore],
        ids=[name for part in parts for name in part.ids],
        gsd_m=parts[0].gsd_m,
    )
