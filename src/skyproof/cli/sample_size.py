"""How large must a test be? The command `sample-size`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from skyproof.cli.console import say
from skyproof.ranges import Fraction

if TYPE_CHECKING:
    from skyproof.results.statistics.planning import Assumptions

__all__ = ["SampleSize"]

_EASR = 0.8
_VEHICLES_PER_TILE = 9.0
_CORRELATION = 0.1


@dataclass(frozen=True)
class SampleSize:
    """Says how many test vehicles a wanted precision needs.

    The precision is the half-width of the 95 % interval of EASR, for one detector.

    Attributes:
        half_width: the wanted half-width, as a fraction: 0.05 is plus or minus 5 percentage points.
        pilot: score folder that all the rest is estimated from; what is given here too wins.
        easr: expected EASR, as a fraction; the pilot's least certain, or 0.8, where not given.
        enhancement_rate: expected ER; the pilot's, or 0, where not given.
        vehicles_per_tile: test vehicles in sight per background tile; the pilot's, or 9, where not
            given.
        intra_tile_correlation: how alike vehicles of one tile fare, from 0 (independent) to 1; the
            pilot's, or 0.1, where not given.
    """

    half_width: Annotated[float, Meta(ge=0.001, lt=1)] = 0.05
    pilot: Path | None = None
    easr: Annotated[float, Meta(ge=-1, le=1)] | None = None
    enhancement_rate: Fraction | None = None
    vehicles_per_tile: Annotated[float, Meta(gt=0, le=10_000)] | None = None
    intra_tile_correlation: Fraction | None = None

    def run(self) -> None:
        """Prints the answer and what other half-widths would need."""
        from skyproof.results.statistics.planning import SMALLEST, vehicles_needed

        assumptions, source = self._assumptions()
        need = vehicles_needed(self.half_width, assumptions)
        say(
            f"About {need.vehicles:,} test vehicles on {need.tiles:,} background tiles: then the "
            f"95 % interval of an EASR of {100 * assumptions.easr:.0f} % is about "
            f"±{100 * self.half_width:.3g} percentage points."
        )
        say("")
        say("  half-width  vehicles    tiles")
        for factor in (2.0, 1.0, 0.5, 0.25):
            wanted = self.half_width * factor
            if SMALLEST <= wanted < 1:
                other = vehicles_needed(wanted, assumptions)
                say(f"  {f'±{100 * wanted:.3g} %':>10}  {other.vehicles:>8,}  {other.tiles:>7,}")
        say("")
        say(
            f"For one detector, {source}: {assumptions.vehicles_per_tile:.3g} vehicles a tile, "
            f"{100 * assumptions.found_before:.0f} % of them found before, "
            f"ER {100 * assumptions.enhancement_rate:.1f} %, "
            f"design effect {assumptions.design_effect:.2f}."
        )

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
        }
        known = {name: value for name, value in given.items() if value is not None}
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
        assumptions, name = assume_from_pilot(read_tiles(self.pilot / "tiles.parquet"))
        return assumptions, f"as {name} in the pilot"
