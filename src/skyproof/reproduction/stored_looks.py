"""What camouflages look like, as a run folder's `looks/looks.json` says it."""

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
    """Shares of a texture's area by where its colours lie in the RGB cube (section S7).

    Colours drawn uniformly from [0, 1], and then rounded to 8 bits, have 32.2 % at the faces, 4.1 %
    at the edges and 0.2 % at the corners.

    Attributes:
        faces: share with one channel or more at an end.
        edges: share with two or more.
        corners: share with all three: black, white, and the six full colours.
        histogram: red, green and blue, each with the shares of its bins from dark to bright.
    """

    name: Name
    faces: Fraction
    edges: Fraction
    corners: Fraction
    histogram: Annotated[list[_Bins], Meta(min_length=3, max_length=3)]


class PairLooks(Struct, frozen=True):
    """How alike two repeats are on the vehicles that wear them.

    Attributes:
        correlation: correlation of the values, mean over the channels; None if one channel of
            either is constant. Unrelated textures have 0.
        distance: mean distance of the colours in CIELAB (CIE 1976). 2.3 can just be noticed (Mahy
            and others 1994).
        seen_correlation, seen_distance: the same, as coarsely as the renderer reads textures.
    """

    first: Name
    second: Name
    correlation: _Correlation | None
    distance: _Distance
    seen_correlation: _Correlation | None
    seen_distance: _Distance


class Strip(Struct, frozen=True):
    """Sample images side by side, with the file relative to `looks.json`."""

    label: Label
    file: FileReference


class Looks(Struct, frozen=True, omit_defaults=True):
    """All that is measured of what camouflages look like.

    Attributes:
        vehicles: number of vehicles that wore the textures.
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
    """Reads the looks of camouflages; None if they were not measured.

    Raises:
        StoredFileError: `looks.json` is damaged.
    """
    path = folder / "looks.json"
    if not path.exists():
        return None
    return read_document(path, Looks, "copy the whole folder again, or score again")
