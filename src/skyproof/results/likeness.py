"""Whether a detector sees rendered vehicles like photographed ones, on the same ground. No torch.

A verdict on renders is valid only if the detector under test scores them like photographs.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import Fraction, Match, Metres, Name, WholeNumber
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name, interval, listed, percent

LARGEST_DIFFERENCE = 0.1
"""Largest difference between the two recalls, in either direction, at which renders are valid.

A detector trained on another town found 21 points fewer renders than photographs, those trained on
the same site 2 to 9 (docs/assess.md). Ten points are also the usual gap of a requirement.
"""

LEAST_OVERLAP = 0.3
"""Smallest chance that a vehicle of either kind has the larger score, if renders are valid.

It is loose, because ranks exaggerate: two kinds with a median score of 1.00 each gave 0.36.
"""

FEWEST_VEHICLES = 20
FEWEST_TILES = 5
"""With fewer vehicles of a kind or tiles, the state is unknown; tests simulate so few tiles."""

_LEVELS, _FACTOR, _WHITE, _CHROMA, _LENGTH = 10, 2, 0.01, 3, 0.1
"""Bounds on how looks differ: levels, a factor and a share of white, chroma, a share of length."""

_Share = Annotated[Interval, Meta(ge=0, le=1)]
_Score = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Level = Annotated[float, Meta(ge=0, le=255)]


@dataclass(frozen=True)
class Look:
    """Medians over the boxes of vehicles, in levels of 8 bits, CIELAB and metres.

    `white_share` is the mean share of pixels in which every channel is at its brightest value, and
    the length is the longer side of a box.
    """

    dark_level: _Level  # 2nd percentile of luminance
    bright_level: _Level  # 98th percentile
    white_share: Fraction
    chroma: Annotated[float, Meta(ge=0, le=1e3)]
    length_m: Metres


@dataclass(frozen=True)
class Difference:
    """One measure of both looks, in words, with a clause on its meaning if it is out of bounds."""

    name: str
    photographed: str
    rendered: str
    bound: str
    clause: str  # empty within the bound


State = Literal["alike", "borderline", "not alike", "unknown"]


@dataclass(frozen=True)
class Likeness:
    """One detector on photographed and rendered vehicles of the same tiles, by one match rule.

    Recalls are at the frozen threshold. A vehicle has the score of its detection, 0 without one.
    `higher` is the chance that a photographed vehicle has a larger score than a rendered one.
    Intervals are over the tiles that show both.
    """

    detector: Name
    dataset: Annotated[str, Meta(min_length=1, max_length=300)]
    match: Match
    tiles: WholeNumber
    photographed: WholeNumber
    rendered: WholeNumber
    recall_photographed: _Share
    recall_rendered: _Share
    recall_difference: Annotated[Interval, Meta(ge=-1, le=1)]
    median_photographed: _Score
    median_rendered: _Score
    higher: _Share
    photographs: Look | None = None
    renders: Look | None = None

    @property
    def state(self) -> State:
        """Whether both kinds are seen alike; not if a whole interval lies out of bounds."""
        few = min(self.photographed, self.rendered) < FEWEST_VEHICLES
        if few or self.tiles < FEWEST_TILES or math.isnan(self.higher.low):
            return "unknown"
        bounds = (
            (self.recall_difference, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE),
            (self.higher, LEAST_OVERLAP, 1 - LEAST_OVERLAP),
        )
        if any(value.high < low or value.low > high for value, low, high in bounds):
            return "not alike"
        within = all(low <= value.estimate <= high for value, low, high in bounds)
        return "alike" if within else "borderline"

    @property
    def judges_nobody(self) -> bool:
        """Whether renders are surely not seen like photographs, so no verdict can rest on them."""
        return self.state == "not alike"

    @property
    def title(self) -> str:
        """The finding for a reader who knows that it is about renders."""
        titles: dict[State, str] = {
            "alike": "valid",
            "borderline": "in doubt",
            "not alike": "NOT VALID",
            "unknown": "not comparable",
        }
        return titles[self.state]

    @property
    def outcome(self) -> str:
        """The state in the words of a precheck criterion's outcome."""
        outcomes = {"alike": "passed", "not alike": "failed", "unknown": "missing"}
        return outcomes.get(self.state, "borderline")

    @property
    def sentence(self) -> str:
        """The finding in one sentence, or two with what differs."""
        name = detector_name(self.detector)
        same = "tile" if self.tiles == 1 else f"{self.tiles} tiles"
        on = f"on the same {same} of {self.dataset}"
        if self.state == "unknown":
            return (
                f"It cannot be said whether {name} sees rendered vehicles like photographed ones: "
                f"{self.rendered} rendered and {self.photographed} labelled vehicles {on} are too "
                f"few ({FEWEST_VEHICLES} of each on {FEWEST_TILES} tiles are needed)."
            )
        says = {"alike": "scores", "not alike": "does not score"}
        verb = says.get(self.state, "seems not to score")
        return (
            f"{name} {verb} rendered vehicles like photographed ones: it finds "
            f"{sure(self.recall_rendered)} of {self.rendered} and {sure(self.recall_photographed)} "
            f"of {self.photographed} {on}, with median scores of {self.median_rendered:.2f} and "
            f"{self.median_photographed:.2f}. In {sure(self.higher)} of pairs the photographed "
            f"vehicle scores higher.{self.differing}"
        )

    @property
    def differing(self) -> str:
        """A sentence on how the images differ, if the kinds are not seen alike; else empty."""
        clauses = [each.clause for each in self.differences if each.clause]
        if self.state not in ("borderline", "not alike"):
            return ""
        if not clauses:
            return " Brightness, colour and size of the vehicles do not tell why."
        return f" Rendered vehicles {listed(clauses)}."

    @property
    def differences(self) -> list[Difference]:
        """The measures of both looks, compared; empty if they were not measured."""
        if self.photographs is None or self.renders is None:
            return []
        return [*_differences(self.photographs, self.renders)]


def _differences(photographs: Look, renders: Look) -> Iterator[Difference]:
    levels = (
        ("2nd percentile of luminance", "dark_level", "have {} darkest parts"),
        ("98th percentile of luminance", "bright_level", "have {} brightest parts"),
    )
    for name, attribute, clause in levels:
        first, second = getattr(photographs, attribute), getattr(renders, attribute)
        word = "brighter" if second > first else "darker"
        out = abs(second - first) > _LEVELS
        said = f"{clause.format(word)} ({name} {second:.0f} against {first:.0f})"
        yield Difference(name, f"{first:.0f}", f"{second:.0f}", f"± {_LEVELS}", said if out else "")
    first, second = photographs.white_share, renders.white_share
    out = abs(second - first) > _WHITE and not first / _FACTOR <= second <= first * _FACTOR
    shown, others = percent(first, 1), percent(second, 1)
    said = f"hold {'more' if second > first else 'less'} pure white ({others} against {shown})"
    yield Difference("pure white pixels", shown, others, f"× {_FACTOR}", said if out else "")
    first, second = photographs.chroma, renders.chroma
    out = abs(second - first) > _CHROMA
    said = f"are {'more' if second > first else 'less'} colourful (chroma {second:.0f} against "
    said += f"{first:.0f})"
    yield Difference("chroma", f"{first:.0f}", f"{second:.0f}", f"± {_CHROMA}", said if out else "")
    first, second = photographs.length_m, renders.length_m
    out = abs(second - first) > _LENGTH * first
    said = f"are {'longer' if second > first else 'shorter'} ({second:.1f} against {first:.1f} m)"
    shown, others, bound = f"{first:.1f} m", f"{second:.1f} m", f"± {percent(_LENGTH)}"
    yield Difference("longer side of the box", shown, others, bound, said if out else "")


def sure(value: Interval) -> str:
    """A share with its interval, "81 % (70 to 90 %)", or alone where that is undefined."""
    shown = percent(value.estimate)
    return shown if math.isnan(value.low) else f"{shown} ({interval(value.low, value.high)})"
