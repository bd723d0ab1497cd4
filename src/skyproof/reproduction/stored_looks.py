"""What camouflages look like, as a score folder's `looks.json` says it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from skyproof.documents import read_document
from skyproof.ranges import FileReference, Fraction, Name, WholeNumber
from skyproof.results.stored import Label

_Correlation = Annotated[float, Meta(ge=-1, le=1)]
_Distance = Annotated[float, Meta(ge=0, le=1000)]
_Bins = Annotated[list[Fraction], Meta(min_length=1, max_length=256)]


class TextureLooks(Struct, frozen=True):
    """Where the colours of one texture lie in the RGB cube, as `ColourCounts` counts them."""

    name: Name
    faces: Fraction
    edges: Fraction
    corners: Fraction
    histogram: Annotated[list[_Bins], Meta(min_length=3, max_length=3)]


class PairLooks(Struct, frozen=True):
    """How alike two repeats are, as `Likeness` says it.

    Attributes:
        first, second: names with their repeats.
        correlation, distance: texel by texel.
        seen_correlation, seen_distance: as coarsely as the renderer reads textures.
    """

    first: Name
    second: Name
    correlation: _Correlation | None
    distance: _Distance
    seen_correlation: _Correlation | None
    seen_distance: _Distance


class Strip(Struct, frozen=True):
    """Sample images side by side: what they show, and the file, relative to the score folder."""

    label: Label
    file: FileReference


class Looks(Struct, frozen=True):
    """All that is measured of what camouflages look like.

    Attributes:
        vehicles: how many wore the textures.
        textures: a row for each, repeats and draws apart.
        pairs: a row for every two repeats that were compared.
        samples: the same scenes without vehicles, with them, and with camouflages.
        sensor: the same vehicles by the renderer's steps towards a photograph.
    """

    vehicles: WholeNumber
    textures: list[TextureLooks]
    pairs: list[PairLooks]
    samples: list[Strip] = []
    sensor: list[Strip] = []


def read_looks(folder: Path) -> Looks | None:
    """Reads what a score folder says of the looks of camouflages; None where nothing is said.

    Raises:
        StoredFileError: `looks.json` is damaged.
    """
    path = folder / "looks.json"
    if not path.exists():
        return None
    return read_document(path, Looks, "copy the whole folder again, or score again")
