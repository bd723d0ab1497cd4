"""What a number, a name or a file reference may be."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import (
    Coordinate,
    Count,
    FileReference,
    Fraction,
    GroundResolution,
    ImageSide,
    Metres,
    Name,
    Radians,
    Seed,
    WholeNumber,
    check_ranges,
    check_value,
    is_name,
    limits_of,
)

HINTS = [Count, WholeNumber, Seed, Fraction, Metres, GroundResolution, ImageSide, Coordinate]
HINTS += [Radians, Name, FileReference]
FLOATS = [Fraction, Metres, GroundResolution, Coordinate, Radians]
WHOLES = [Count, WholeNumber, Seed, ImageSide]


def fits(value: Any, hint: Any) -> bool:
    try:
        check_value("it", value, hint)
    except ConfigurationError as error:
        message = str(error)
        assert message.startswith("it expects ")
        assert "\n" not in message
        assert len(message) < 400
        return False
    return True


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (Count, [1, 1_000_000], [0, -1, 1_000_001, 2**63, 10**4000, 10**5000, 1.0, True, "1"]),
        (WholeNumber, [0, 1_000_000], [-1, 1_000_001]),
        (Seed, [-1, 0, 2**63 - 1, -(2**63)], [2**63, -(2**63) - 1, 1.5]),
        (Fraction, [0, 0.5, 1], [-1e-9, 1.0001, "0.5", None]),
        (Metres, [0, 1e6], [-1, 1e6 + 1]),
        (GroundResolution, [0.001, 100], [0, -0.0, 100.1]),
        (ImageSide, [1, 16_384], [0, 16_385]),
        (Coordinate, [-1e9, 1e9], [1.1e9, 1e300]),
        (Radians, [-1e3, 1e3], [1e4]),
        (tuple[Fraction, Fraction], [(0, 1)], [(0, 2), (0,), (0, 1, 1), 0]),
        (tuple[Count, ...], [(), (1, 2)], [(1, 0)]),
        (Fraction | None, [None, 0.5], [2.0]),
        (Name, ["a", "T-U", ".hidden", "a..b", "ü" * 150], ["", ".", "..", "...", "a/b", "a\\b"]),
        (Name, [], ["a\0b", "a\nb", "a\n", "x" * 151, "C:", "\x7f", 3, "../../../x"]),
        (FileReference, ["a.png", "images/0001.png", "a/b/c"], ["/etc/passwd", "../a", "a/../b"]),
        (FileReference, [], ["a//b", "a/", "./a", "a/.", "a\\..\\b", "a\0b", "C:/a", "a/b\n", ""]),
        (FileReference, ["/".join("a" * 8)], ["/".join("a" * 9), "a/" + "x" * 151]),
    ],
)
def test_what_fits(hint: Any, good: list[Any], bad: list[Any]) -> None:
    assert [value for value in good if not fits(value, hint)] == []
    assert [value for value in bad if fits(value, hint)] == []


@pytest.mark.parametrize("hint", FLOATS + WHOLES)
def test_nothing_endless_fits_anywhere(hint: Any) -> None:
    for value in (math.nan, math.inf, -math.inf, 1e300, -1e300, np.float64(np.nan)):
        assert not fits(value, hint)
        assert not fits((0.5, value), tuple[hint, ...])


def test_numbers_of_numpy_and_torch_fit_as_pythons_own_do() -> None:
    assert fits(np.int64(3), Count)
    assert fits(np.float32(0.5), Fraction)
    assert fits(torch.tensor(0.5), Fraction)
    assert fits([np.int64(3)], tuple[Count, ...])
    assert not fits(np.int64(0), Count)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.text(max_size=200) | st.text(alphabet="./\\:a\0\n", max_size=12))
def test_a_name_is_one_file_in_its_folder(tmp_path_factory: Any, text: str) -> None:
    """Compared with what the path library makes of it."""
    from pathlib import PurePosixPath, PureWindowsPath

    if not is_name(text):
        return
    for kind in (PurePosixPath, PureWindowsPath):
        path = kind("folder") / text
        assert path.parent == kind("folder")
        assert path.name == text
        assert ".." not in path.parts


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.text(alphabet="./\\:ab\0\n", max_size=16))
def test_a_reference_stays_below_its_folder(text: str) -> None:
    import os.path

    if not fits(text, FileReference):
        return
    place = os.path.normpath(os.path.join("/folder", text))
    assert place == f"/folder/{text}"


@dataclass(frozen=True)
class Settings:
    share: Fraction = 0.5
    sides: tuple[ImageSide, ImageSide] = (1, 1)
    seed: Seed = 0
    own: Annotated[float, Meta(gt=0, lt=10)] = 1
    free: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)


def test_settings_are_checked_field_by_field() -> None:
    Settings(share=1, sides=(2, 3), seed=-1, own=9.9, free="../..")
    for wrong, words in (
        ({"share": 1.5}, "share expects a number from 0 up to 1, got 1.5"),
        ({"sides": (1, 0)}, "sides expects values, each a whole number from 1 up to 16,384"),
        ({"seed": 2**63}, "seed expects a whole number of at most 64 bits"),
        ({"own": 10.0}, "own expects a number above 0 to below 10"),
        ({"own": math.nan}, "own expects a number above 0 to below 10, got nan"),
    ):
        with pytest.raises(ConfigurationError) as caught:
            Settings(**wrong)
        assert words in str(caught.value)


def test_limits_are_those_of_the_annotations() -> None:
    assert limits_of(Settings)["share"] == Fraction
    assert limits_of(Settings)["free"] is str
