"""Squares of pixels, one around each vehicle, in which it is drawn by itself."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Windows:
    """One square of whole pixels per vehicle from its top-left pixel (x, y) on, all of one size."""

    origin: Int[Tensor, "N 2"]
    size: int

    def samples(self, screen: Float[Tensor, "N V 2"], factor: int) -> Float[Tensor, "N V 2"]:
        """Image pixels to samples of the window."""
        return (screen - self.origin[:, None].to(screen.dtype)) * factor


@torch.no_grad()
def windows_around(screen: Float[Tensor, "N V 2"]) -> Windows:
    """Windows that hold every vehicle's points with a pixel to spare."""
    low = screen.amin(1).floor() - 1
    high = screen.amax(1).ceil() + 1
    return Windows(low.long(), int((high - low).max()))
