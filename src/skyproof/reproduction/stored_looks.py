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

    One channel or more is at an end at the faces, two or more at the edges, all three at the
    corners. Colours drawn uniformly from [0, 1], and then rounded to 8 bits, have 32.2 % at the
    faces, 4.1 % at the edges and 0.2 % at the corners. The histogram has red, green and blue, each
    from dark to bright.
    """

    name: Name
    faces: Fraction
    edges: Fraction
    corners: Fraction
    histogram: Annotated[list[_Bins], Meta(min_length=3, max_length=3)]


class PairLooks(Struct, frozen=True):
    """How alike two repeats are on the vehicles that wear them.

    The correlation of the values is a mean over the channels; None if one channel of either is
    constant. Unrelated textures have 0. The distance of the colours is a mean in CIELAB (CIE 1976),
    of which 2.3 can just be noticed (Mahy and others 1994). Seen is what the renderer reads of
    textures.
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

    Repeats and draws have rows of their own. Samples are the same scenes without vehicles, with
    them, and with camouflages; sensor the same vehicles by the renderer's steps towards a
    photograph.
    """

    vehicles: WholeNumber
    textures: list[TextureLooks]
    pairs: list[PairLooks]
    samples: list[Strip] = []
    sensor: list[Strip] = []


def read_looks(folder: Path) -> Looks | None:
    """Reads the looks of camouflages; None if they were not measured."""
    path = folder / "looks.json"
    if not path.exists():
        return None
    return read_document(path, Looks, "copy the whole folder again, or score again")
