"""What a camouflage's name leaves open; imports no torch, so that the command line is quick."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import Count, check_ranges

_MAP_TEXELS = 512

Colours = Annotated[int, Meta(ge=2, le=256)]
"""How many colours a palette has."""

Blocks = Annotated[int, Meta(ge=1, le=_MAP_TEXELS)]
"""Pixel blocks along a side of the map."""


@dataclass(frozen=True)
class CamouflageSettings:
    """The numbers of a camouflage that its name does not state; the defaults are the paper's.

    Attributes:
        colours: number of colours of Lc and Fc (section 5.4).
        blocks: pixel blocks along a side of the map, for Pix; must divide its 512 texels.
        turn_steps: steps after which a parallel combination changes sides.
    """

    colours: Colours = 5
    blocks: Blocks = 32
    turn_steps: Count = 10

    def __post_init__(self) -> None:
        check_ranges(self)
        if _MAP_TEXELS % self.blocks:
            raise ConfigurationError(
                f"blocks expects a divisor of the map's {_MAP_TEXELS} texels a side, got "
                f"{self.blocks}; give for instance 32."
            )
