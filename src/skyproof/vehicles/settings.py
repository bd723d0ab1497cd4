"""Settings of vehicles' paints and of wrapped meshes. Imports no torch, for a fast command line."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, Name, WholeNumber, check_ranges

VehicleCount = Annotated[int, Meta(ge=1, le=10_000)]
"""How many vehicles are drawn at once; each takes 1 MB of memory."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""A direction in a mesh file."""


@dataclass(frozen=True)
class PaintVariety:
    """Shares of a fleet that are painted otherwise than real vehicles.

    The rest has catalogue paints, of which four in five are white, black, grey or silver. The
    defaults are meant for training: detectors that learnt them do not take colour for evidence.

    Attributes:
        plain: share in one colour, uniform in CIELAB or muted; on half of them it covers glass and
            wheels, too.
        two_tone: share in two such colours, with another one on roof, upper or lower half.
        livery: share with such colours in stripes, bands, chequers and panels.
        patterned: share in another random control of all textures in every image; six of eighteen
            kinds lie on painted panels alone.
    """

    plain: Fraction = 0.15
    two_tone: Fraction = 0.075
    livery: Fraction = 0.075
    patterned: Fraction = 0.3

    def __post_init__(self) -> None:
        check_ranges(self)
        if sum(self.shares.values()) > 1 + 1e-9:
            raise ConfigurationError(
                f"Shares of a fleet's paints expect to sum to at most 1, got "
                f"{sum(self.shares.values()):g}; lower some of plain, two_tone, livery, patterned."
            )

    @property
    def shares(self) -> dict[str, float]:
        """Returns the shares by kind of paint; the rest of the fleet has catalogue paints."""
        return dict(vars(self))


CATALOGUE_PAINTS = PaintVariety(plain=0.0, two_tone=0.0, livery=0.0, patterned=0.0)
"""The paints of real vehicles, which tested vehicles have."""


@dataclass(frozen=True)
class WrapSettings:
    """How meshes are read and named.

    Attributes:
        scale: metres per unit, one value for all meshes or one per mesh (default: 1).
        up: axis that points up (default: that of the format, or guessed).
        forward: axis of the nose (default: guessed, and reported).
        names: body type of each mesh; the file names if empty. Ids are <body type>-<number>.
        first_number: number of the first vehicle.
        paintable: picture on the mesh's own UVs, bright on paint (default: the textures' alpha).
        licence: owner and terms of the meshes; stored with every vehicle.
        minimum_iou: lowest IoU of the outline from above; other vehicles are refused.
    """

    scale: tuple[Annotated[float, Meta(gt=0, le=1e6)], ...] = ()
    up: Axis | None = None
    forward: Axis | None = None
    names: Suppress[tuple[Name, ...]] = ()
    first_number: Suppress[WholeNumber] = 1000
    paintable: Path | None = None
    licence: Annotated[str, Meta(max_length=1000)] = "not stated"
    minimum_iou: Suppress[Fraction] = 0.97

    def __post_init__(self) -> None:
        check_ranges(self)

    def of_meshes(self, meshes: list[Path]) -> list[tuple[Path, str, float | None]]:
        """Returns each mesh with its name and its metres per unit (None: not given)."""
        for flag, given, single in (("scale", self.scale, True), ("names", self.names, False)):
            if given and len(given) != len(meshes) and not (single and len(given) == 1):
                raise ConfigurationError(
                    f"--wrapping.{flag} expects one value per mesh ({len(meshes)}), got "
                    f"{len(given)}."
                )
        names = self.names or tuple(mesh.stem for mesh in meshes)
        scales: tuple[float | None, ...] = self.scale or (None,)
        if len(scales) == 1:
            scales = scales * len(meshes)
        return list(zip(meshes, names, scales, strict=True))
