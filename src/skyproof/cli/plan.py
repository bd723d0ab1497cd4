"""How large must the test be? The command `plan`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.errors import ConfigurationError
from skyproof.results.planning import SMALLEST, Assumptions, assume_from_pilot, vehicles_needed
from skyproof.results.tiles import read_tiles

__all__ = ["Plan"]

_EASR, _VEHICLES_PER_TILE, _CORRELATION = 0.8, 9.0, 0.1


@dataclass(frozen=True)
class Plan:
    """Says how many test vehicles a wanted half-width of the 95 % interval of EASR needs, for one detector.

    Attributes:
        half_width: wanted, as a fraction: 0.05 is plus or minus 5 percentage points.
        pilot: evaluation folder to estimate all the rest from (its tiles.parquet); what is given here too wins.
        easr: expected EASR, as a fraction; default the pilot's least certain, or 0.8.
        enhancement_rate: expected ER; default the pilot's, or 0.
        vehicles_per_tile: test vehicles in sight per background tile; default the pilot's, or 9.
        intra_tile_correlation: how alike vehicles of one tile fare, 0 (independent) to 1; default the pilot's, or 0.1.
    """

    half_width: float = 0.05
    pilot: Path | None = None
    easr: float | None = None
    enhancement_rate: float | None = None
    vehicles_per_tile: float | None = None
    intra_tile_correlation: float | None = None

    def run(self) -> None:
        """Prints the answer and what other half-widths would need."""
        assumptions, source = self._assumptions()
        need = vehicles_needed(self.half_width, assumptions)
        say(
            f"About {need.vehicles:,} test vehicles on {need.tiles:,} background tiles: then the 95 % interval of "
            f"an EASR of {100 * assumptions.easr:.0f} % is about ±{100 * self.half_width:.3g} percentage points."
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
            f"ER {100 * assumptions.enhancement_rate:.1f} %, design effect {assumptions.design_effect:.2f}."
        )

    def _assumptions(self) -> tuple[Assumptions, str]:
        correlation = self.intra_tile_correlation
        if correlation is not None and not 0 <= correlation <= 1:
            raise ConfigurationError(
                f"--intra-tile-correlation expects a number from 0 to 1, got {correlation:g}."
            )
        if self.pilot is None:
            start, source = Assumptions(_EASR, vehicles_per_tile=_VEHICLES_PER_TILE), "assumed"
            correlation = _CORRELATION if correlation is None else correlation
        else:
            start, name = assume_from_pilot(read_tiles(self.pilot / "tiles.parquet"))
            source = f"as {name} in the pilot"
            if self.vehicles_per_tile is not None and correlation is None:
                # The design effect belongs to the pilot's tiles; what carries over is the correlation.
                correlation = (start.design_effect - 1) / max(
                    start.vehicles_per_tile * start.found_before - 1, 1e-9
                )
                correlation = min(correlation, 1.0)
        given = {
            "easr": self.easr,
            "enhancement_rate": self.enhancement_rate,
            "vehicles_per_tile": self.vehicles_per_tile,
        }
        made = dataclasses.replace(
            start, **{name: value for name, value in given.items() if value is not None}
        )
        if correlation is None:
            return made, source
        found = made.vehicles_per_tile * made.found_before
        return dataclasses.replace(
            made, design_effect=1 + max(found - 1, 0.0) * correlation
        ), source
