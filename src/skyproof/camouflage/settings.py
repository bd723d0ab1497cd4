"""What a camouflage's name leaves open; imports no torch, so that the command line is quick."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CamouflageSettings"]


@dataclass(frozen=True)
class CamouflageSettings:
    """The numbers of a camouflage that its name does not tell; the defaults are the paper's.

    Attributes:
        colours: how many colours Lc learns, and Fc takes from the ground (section 5.4).
        blocks: pixel blocks along a side of the map, for Pix; must divide its 512 texels.
        turn_steps: steps after which a parallel combination changes sides.
    """

    colours: int = 5
    blocks: int = 32
    turn_steps: int = 10
