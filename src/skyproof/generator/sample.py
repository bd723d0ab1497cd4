"""What a generator of vehicles gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


@dataclass(frozen=True)
class Sample:
    """A vehicle on the shared template.

    Attributes:
        body_type: stands before the last hyphen of its id.
        vertices: metres, vehicle axes.
        texture: sRGB as bytes.
        parts: values of `Part`.
    """

    body_type: str
    vertices: Float[Tensor, "V 3"]
    texture: UInt8[Tensor, "3 512 512"]
    parts: UInt8[Tensor, "512 512"]


@runtime_checkable
class VehicleGenerator(Protocol):
    """Draws vehicles like those it learnt from.

    Attributes:
        method: as its folder calls it.
    """

    method: str

    def sample(self, generator: torch.Generator) -> Sample:
        """Draws a vehicle; the same state of the generator gives the same one."""
        ...

    def between(self, count: int, generator: torch.Generator) -> list[Sample]:
        """Draws two vehicles, and gives so many on the way from one to the other, ends included."""
        ...
