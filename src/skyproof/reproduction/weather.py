"""Success in each weather, of what was learnt on clear days and of what was learnt in all weathers.

Differences from the paper (section S7): it learns in weather to see what becomes of a texture's
colours; here success is compared, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skyproof.camouflage.name import IN_WEATHER, CamouflageName
from skyproof.layout import Layout
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Grid,
    Heading,
    Table,
    bracket,
    interval_cells,
    number,
)
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.conditions import shared_groups
from skyproof.results.pairs.outcomes import Outcome
from skyproof.results.results import RENDERER, Results
from skyproof.results.rows import MEAN
from skyproof.results.statistics.contrasts import difference_interval, mean_interval
from skyproof.scenes.weather import CONDITIONS

CLEAR = "clear"
EVERY_WEATHER = "all weathers"
"""All but clear days together."""

_SEED = 0


def weather_tables(run: Reproduction) -> list[Table]:
    """Gives success by weather, detector by detector and on average; none where nothing was scored.

    Raises:
        StoredFileError: a file of the scores in weather is damaged.
        ConfigurationError: they do not belong together.
    """
    place = Layout(run.results.folder).weather
    if not place.scores.exists():
        return []
    scored = Results.open(place.folder)
    bases = dict.fromkeys(name.base for name in scored.names if name.variant == IN_WEATHER)
    judges = [*run.detectors, MEAN] if len(run.detectors) > 1 else run.detectors
    rows = [row for base in bases for row in _rows(base, run.results, scored, judges)]
    return [Table("weather", rows)] if rows else []


def _rows(
    base: CamouflageName, clear: Results, weather: Results, detectors: Sequence[str]
) -> list[dict[str, Any]]:
    """Gives one row per weather and detector; clear days are those of the usual test scenes."""
    names = (base, base.with_variant(IN_WEATHER), base.control)
    on_clear_days = [clear.outcomes(name, RENDERER) for name in names]
    in_weather = [weather.outcomes(name, RENDERER) for name in names]
    seen = {outcome.condition for outcome in in_weather[0]}
    told: dict[str, Sequence[Sequence[Outcome]]] = {CLEAR: on_clear_days}
    for condition in CONDITIONS:
        if condition in seen and condition != CLEAR:
            told[condition] = [
                [outcome for outcome in part if outcome.condition == condition]
                for part in in_weather
            ]
    told[EVERY_WEATHER] = in_weather
    rows = []
    for condition, outcomes in told.items():
        for detector in detectors:
            parts = [
                [outcome for outcome in part if detector in (outcome.detector, MEAN)]
                for part in outcomes
            ]
            if all(parts):
                place = {"attack": str(base), "condition": condition, "detector": detector}
                rows.append(place | _cells(parts))
    return rows


def _cells(parts: Sequence[Sequence[Outcome]]) -> dict[str, Any]:
    """Gives the rates of what was learnt on clear days, in all weathers, and not at all."""
    generator = np.random.default_rng(_SEED)
    sample, (on_clear_days, in_all, drawn) = shared_groups(parts, generator=generator)
    vehicles = {(outcome.scene, outcome.placement) for outcome in parts[0]}
    found = [outcome.detected_original for outcome in parts[0]]
    rates = {
        "clear": mean_interval(on_clear_days, sample),
        "all": mean_interval(in_all, sample),
        "random": mean_interval(drawn, sample),
        "net_clear": difference_interval([on_clear_days], [drawn], sample),
        "net_all": difference_interval([in_all], [drawn], sample),
        "gain": difference_interval([in_all], [on_clear_days], sample),
    }
    cells: dict[str, Any] = {"vehicles": len(vehicles), "found_before": 100 * float(np.mean(found))}
    for name, rate in rates.items():
        cells |= interval_cells(name, rate, 100.0)
    return cells


def weather_section(run: Reproduction, tables: Mapping[str, Table]) -> list[Block]:
    """Says what becomes of success in weather; empty where nothing was scored there."""
    if "weather" not in tables:
        return []
    wanted = MEAN if len(run.detectors) > 1 else run.detectors[0]
    rows = [row for row in tables["weather"].rows if row["detector"] == wanted]
    conditions = dict.fromkeys(row["condition"] for row in rows)
    names = dict.fromkeys(row["attack"] for row in rows)
    return [
        Heading("In weather"),
        "The other tables show clear days, on which all else here was learnt. "
        f"{', '.join(names)} was also learnt in all weathers, with as many steps, and both are "
        "judged in every weather: “clear” are the usual test scenes, the others scenes drawn "
        f"alike, each in one of {len(conditions) - 2} weathers; “{EVERY_WEATHER}” are these "
        "together. Rates as above, in percent; a vehicle counts where it was found in that weather "
        "without camouflage. “net” is minus the random control in that weather, “gain” what "
        "learning in all weathers adds to learning on clear days, vehicle by vehicle.",
        Figure("weather", "Success by weather, learnt on clear days and in all weathers"),
        Grid(
            [
                *("attack", "weather", "vehicles", "found before", "learnt clear", "net"),
                *("learnt in all", "net", "gain", "random"),
            ],
            [_line(row) for row in rows],
        ),
        *_readings(rows),
    ]


def _line(row: Mapping[str, Any]) -> list[str]:
    return [
        row["attack"],
        row["condition"].replace("_", " "),
        str(row["vehicles"]),
        number(row["found_before"]),
        bracket(row, "clear"),
        bracket(row, "net_clear"),
        bracket(row, "all"),
        bracket(row, "net_all"),
        bracket(row, "gain"),
        number(row["random"]),
    ]


def _readings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Says per attack where learning in all weathers surely changes what is hidden."""
    said = []
    for name in dict.fromkeys(row["attack"] for row in rows):
        own = [row for row in rows if row["attack"] == name]
        more = [row["condition"].replace("_", " ") for row in own if row["gain_low"] > 0]
        less = [row["condition"].replace("_", " ") for row in own if row["gain_high"] < 0]
        found = [
            f"{word} in {', '.join(conditions)}"
            for word, conditions in (("surely more", more), ("surely less", less))
            if conditions
        ]
        said.append(
            f"Learnt in all weathers, {name} hides {'; '.join(found)}."
            if found
            else f"Whether {name} was learnt on clear days or in all weathers makes no sure "
            "difference in any weather."
        )
    return [" ".join(said)]
