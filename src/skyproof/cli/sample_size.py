"""How large must a test be? The command `sample-size`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from skyproof.cli.console import say
from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, Risk

if TYPE_CHECKING:
    from skyproof.results.statistics.acceptance import Requirement
    from skyproof.results.statistics.planning import Assumptions

_EASR = 0.8
_VEHICLES_PER_TILE = 9.0
_CORRELATION = 0.1


@dataclass(frozen=True)
class SampleSize:
    """Says how many test vehicles a wanted precision needs.

    The precision is the half-width of the 95 % interval of EASR, or with --draws of the net EASR,
    for one detector. The interval is over background tiles and the vehicles of the fleet and, where
    there are several, over seeds of the attack, draws of the control and trainings of the detector.

    Attributes:
        half_width: the wanted half-width, as a fraction: 0.05 is plus or minus 5 percentage points.
        pilot: score folder that all the rest is estimated from; what is given here too wins.
        easr: expected EASR, as a fraction; the pilot's least certain, or 0.8, where not given.
        enhancement_rate: expected ER; the pilot's, or 0, where not given.
        vehicles_per_tile: test vehicles in sight per background tile; the pilot's, or 9, where not
            given.
        intra_tile_correlation: how alike vehicles of one tile fare, from 0 (independent) to 1; the
            pilot's, or 0.1, where not given.
        fleet: different vehicles in the test; the pilot's, or 32, where not given.
        intra_vehicle_correlation: how alike one vehicle fares on different tiles, from 0 to 1; the
            pilot's, or 0.05, where not given.
        seeds: attacks from different seeds whose mean is wanted; 1 for what one camouflage does.
        seed_sd: standard deviation of their EASRs; the pilot's, or 0.03, where not given.
        draws: of the random control, for the net EASR; 0 for the EASR.
        draw_sd: standard deviation of their EASRs; the pilot's, or 0.2, where not given.
        trainings: of the detector, each attacked for itself; 1 for what is true of this one.
        training_sd: standard deviation of their EASRs, or of their net EASRs with --draws; 0.1
            where not given, as a pilot is of one training.
        accept: instead of a precision, the share of found vehicles that a detector may lose; with
            `reject`. The answer is the test that decides between the two.
        reject: the share lost from which on it is refused.
        producer_risk: chance at most that a detector which loses `accept` is rejected.
        consumer_risk: chance at most that one which loses `reject` is accepted.
    """

    half_width: Annotated[float, Meta(ge=0.001, lt=1)] = 0.05
    pilot: Path | None = None
    easr: Annotated[float, Meta(ge=-1, le=1)] | None = None
    enhancement_rate: Fraction | None = None
    vehicles_per_tile: Annotated[float, Meta(gt=0, le=10_000)] | None = None
    intra_tile_correlation: Fraction | None = None
    fleet: Annotated[int, Meta(ge=1, le=10**6)] | None = None
    intra_vehicle_correlation: Fraction | None = None
    seeds: Annotated[int, Meta(ge=1, le=1000)] = 1
    seed_sd: Fraction | None = None
    draws: Annotated[int, Meta(ge=0, le=1000)] = 0
    draw_sd: Fraction | None = None
    trainings: Annotated[int, Meta(ge=1, le=1000)] = 1
    training_sd: Fraction | None = None
    accept: Fraction | None = None
    reject: Fraction | None = None
    producer_risk: Risk = 0.05
    consumer_risk: Risk = 0.05

    def run(self) -> None:
        """Prints the answer, and what other half-widths would need."""
        from skyproof.results.statistics.acceptance import requirement_of

        requirement = requirement_of(
            self.accept, self.reject, self.producer_risk, self.consumer_risk
        )
        if requirement is not None:
            self._say_what_decides(requirement)
            return
        from skyproof.results.statistics.planning import SMALLEST, vehicles_needed

        assumptions, source = self._assumptions()
        need = vehicles_needed(self.half_width, assumptions)
        what = "the net of an EASR" if assumptions.draws else "an EASR"
        say(
            f"About {need.vehicles:,} test vehicles on {need.tiles:,} background tiles: then the "
            f"95 % interval of {what} of {100 * assumptions.easr:.0f} % is about "
            f"±{100 * self.half_width:.3g} percentage points."
        )
        say(_limiting(need.tiles, assumptions))
        say("")
        say("  half-width  vehicles    tiles")
        for factor in (2.0, 1.0, 0.5, 0.25):
            wanted = self.half_width * factor
            if SMALLEST <= wanted < 1:
                try:
                    other = vehicles_needed(wanted, assumptions)
                    counts = (f"{other.vehicles:,}", f"{other.tiles:,}")
                except ConfigurationError:
                    counts = ("–", "–")
                say(f"  {f'±{100 * wanted:.3g} %':>10}  {counts[0]:>8}  {counts[1]:>7}")
        say("")
        say(
            f"For one detector, {source}: {_tiles_told(assumptions)}, "
            f"ER {100 * assumptions.enhancement_rate:.1f} %; a fleet of {assumptions.fleet:,} "
            f"whose vehicles fare alike by {assumptions.vehicle_correlation:.2f}"
            + _repeats(assumptions)
            + ". A dash: no number of tiles is enough."
        )

    def _say_what_decides(self, requirement: Requirement) -> None:
        """Prints how large a test decides about a requirement."""
        from skyproof.results.statistics.compliance import tiles_to_decide

        assumptions, source = self._assumptions()
        tiles = tiles_to_decide(requirement, assumptions)
        good, bad = f"{100 * requirement.accept:.3g} %", f"{100 * requirement.reject:.3g} %"
        say(
            f"About {math.ceil(tiles * assumptions.vehicles_per_tile):,} test vehicles on "
            f"{tiles:,} background tiles: then nine of ten tests accept a detector that loses "
            f"{good} of its found vehicles, and reject one that loses {bad}; at most "
            f"{100 * self.producer_risk:.3g} and {100 * self.consumer_risk:.3g} % err."
        )
        say("")
        say(f"For one detector, {source}: {_tiles_told(assumptions)}.")

    def _assumptions(self) -> tuple[Assumptions, str]:
        correlation = self.intra_tile_correlation
        start, source = self._start()
        if self.pilot is None and correlation is None:
            correlation = _CORRELATION
        elif self.vehicles_per_tile is not None and correlation is None:
            # The design effect belongs to the pilot's tiles; what carries over is the correlation.
            found_per_tile = start.vehicles_per_tile * start.found_before
            correlation = min((start.design_effect - 1) / max(found_per_tile - 1, 1e-9), 1.0)
        given = {
            "easr": self.easr,
            "enhancement_rate": self.enhancement_rate,
            "vehicles_per_tile": self.vehicles_per_tile,
            "fleet": self.fleet,
            "vehicle_correlation": self.intra_vehicle_correlation,
            "seeds": self.seeds,
            "seed_sd": self.seed_sd,
            "draws": self.draws,
            "draw_sd": self.draw_sd,
            "trainings": self.trainings,
            "training_sd": self.training_sd,
        }
        known: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        assumptions = replace(start, **known)
        if correlation is None:
            return assumptions, source
        found_per_tile = assumptions.vehicles_per_tile * assumptions.found_before
        effect = 1 + max(found_per_tile - 1, 0.0) * correlation
        return replace(assumptions, design_effect=effect), source

    def _start(self) -> tuple[Assumptions, str]:
        from skyproof.results.pairs.tiles import read_tiles
        from skyproof.results.statistics.planning import Assumptions, assume_from_pilot

        if self.pilot is None:
            return Assumptions(_EASR, vehicles_per_tile=_VEHICLES_PER_TILE), "assumed"
        assumptions, name = assume_from_pilot(read_tiles(self.pilot / "outcomes.parquet"))
        return assumptions, f"as {name} in the pilot"


def _limiting(tiles: int, assumptions: Assumptions) -> str:
    """Says what makes the interval as wide as it is, the most of it first, and what is left out."""
    from skyproof.results.statistics.planning import parts_of_width

    parts = parts_of_width(tiles, assumptions)
    ordered = sorted(parts, key=lambda name: -parts[name])
    shares = ", ".join(f"{name} {100 * parts[name]:.0f} %" for name in ordered)
    left_out = [
        name
        for name, given in (
            ("other vehicles", assumptions.fleet > 1),
            ("other seeds of the attack", max(assumptions.seeds, assumptions.trainings) > 1),
            ("other draws of the control", assumptions.draws != 1),
            ("other trainings of the detector", assumptions.trainings > 1),
        )
        if not given
    ]
    without = f" It says nothing of {' or '.join(left_out)}." if left_out else ""
    return f"Of its square, {shares}: more {ordered[0]} narrow it most.{without}"


def _tiles_told(assumptions: Assumptions) -> str:
    return (
        f"{assumptions.vehicles_per_tile:.3g} vehicles a tile, "
        f"{100 * assumptions.found_before:.0f} % of them found before, "
        f"design effect {assumptions.design_effect:.2f}"
    )


def _repeats(assumptions: Assumptions) -> str:
    told = (
        ("seeds", assumptions.seeds if assumptions.trainings == 1 else 1, assumptions.seed_sd),
        ("draws", assumptions.draws, assumptions.draw_sd),
        ("trainings", assumptions.trainings, assumptions.training_sd),
    )
    return "".join(
        f"; {count} {what} of standard deviation {sd:.2f}" for what, count, sd in told if count > 1
    )
