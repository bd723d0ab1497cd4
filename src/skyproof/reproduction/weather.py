"""Success in each weather, of textures optimised on clear days and in all weathers.

Differences from the paper (section S7): success is compared, beside the colours of textures.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skyproof.camouflage.name import IN_WEATHER, CamouflageName
from skyproof.report.figures import BLUE, GREY, ORANGE, panels, rule
from skyproof.reproduction.cells import Figure, TextTable, Topic, interval_cells, rate, value
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.conditions import shared_groups
from skyproof.results.outcomes import Outcome
from skyproof.results.result import MEAN
from skyproof.results.results import RENDERER, Results
from skyproof.results.statistics.contrasts import difference_interval, mean_interval
from skyproof.scenes.weather import CONDITIONS

CLEAR = "clear"
EVERY_WEATHER = "all weathers"
"""All but clear days together."""

_SEED = 0
_SERIES = (
    ("clear", "o", BLUE, -0.2, "learnt on clear days"),
    ("all", "^", ORANGE, 0.0, "learnt in all weathers"),
    ("random", "s", GREY, 0.2, "random patterns"),
)


def weather_part(run: Reproduction) -> Topic:
    """Returns success by weather, detector by detector and on average."""
    place = run.layout.weather
    if not place.scores.exists():
        return Topic()
    scored = Results.open(place.folder)
    bases = dict.fromkeys(name.base for name in scored.names if name.variant == IN_WEATHER)
    detectors = [*run.detectors, MEAN] if len(run.detectors) > 1 else run.detectors
    every = [row for base in bases for row in _rows(base, run.results, scored, detectors)]
    if not every:
        return Topic()
    # Of one detector there is no mean.
    rows = [row for row in every if row["detector"] == detectors[-1]]
    conditions = dict.fromkeys(row["condition"] for row in rows)
    names = dict.fromkeys(row["attack"] for row in rows)
    return Topic.of(
        "In weather",
        {"weather": every},
        "The other tables show clear days, on which all else here was learnt. "
        f"{', '.join(names)} was also learnt in all weathers, with as many steps, and both are "
        "judged in every weather: “clear” are the usual test scenes, the others scenes drawn "
        f"alike, each in one of {len(conditions) - 2} weathers; “{EVERY_WEATHER}” are these "
        "together. Rates as above, in percent; a vehicle counts where it was found in that weather "
        "without camouflage. “net” is minus the random control in that weather, “gain” what "
        "learning in all weathers adds to learning on clear days, vehicle by vehicle.",
        Figure(
            "weather", "Success by weather, learnt on clear days and in all weathers", _figure(rows)
        ),
        TextTable.of(
            rows,
            [
                ("attack", "attack"),
                ("weather", _condition),
                ("vehicles", "vehicles"),
                ("found before", value("found_before")),
                ("learnt clear", rate("clear")),
                ("net", rate("net_clear")),
                ("learnt in all", rate("all")),
                ("net", rate("net_all")),
                ("gain", rate("gain")),
                ("random", value("random")),
            ],
        ),
    )


def _rows(
    base: CamouflageName, clear: Results, weather: Results, detectors: Sequence[str]
) -> list[dict[str, Any]]:
    """Returns one row per weather and detector; clear days are those of the usual test scenes."""
    names = (base, base.with_variant(IN_WEATHER), base.control)
    on_clear_days = [clear.outcomes(name, RENDERER) for name in names]
    in_weather = [weather.outcomes(name, RENDERER) for name in names]
    seen = {outcome.condition for outcome in in_weather[0]}
    conditions = [name for name in CONDITIONS if name in seen and name != CLEAR]
    rows = []
    for condition in (CLEAR, *conditions, EVERY_WEATHER):
        outcomes = on_clear_days if condition == CLEAR else in_weather
        if condition in conditions:
            outcomes = [[each for each in part if each.condition == condition] for part in outcomes]
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
    """Returns the rates of textures optimised on clear days, in all weathers, and not at all."""
    generator = np.random.default_rng(_SEED)
    on_clear_days, in_all, drawn = shared_groups(parts, generator=generator)
    vehicles = {(outcome.scene, outcome.placement) for outcome in parts[0]}
    found = [outcome.detected_original for outcome in parts[0]]
    rates = {
        "clear": mean_interval(on_clear_days),
        "all": mean_interval(in_all),
        "random": mean_interval(drawn),
        "net_clear": difference_interval([on_clear_days], [drawn]),
        "net_all": difference_interval([in_all], [drawn]),
        "gain": difference_interval([in_all], [on_clear_days]),
    }
    cells: dict[str, Any] = {"vehicles": len(vehicles), "found_before": 100 * float(np.mean(found))}
    for name, interval in rates.items():
        cells |= interval_cells(name, interval, 100.0)
    return cells


def _condition(row: Mapping[str, Any]) -> str:
    return str(row["condition"]).replace("_", " ")


@figure_style("weather")
def _figure(rows: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """Draws one panel per attack."""
    by_attack = defaultdict(list)
    for row in rows:
        by_attack[row["attack"]].append(row)
    lines = max(map(len, by_attack.values()))
    count = len(by_attack)
    figure, grid = panels(count, 1, 8.5, 1.0 + (0.6 + 0.55 * lines) * count)
    for axes, (attack, own) in zip(grid.flat, by_attack.items(), strict=True):
        _panel(axes, own)
        axes.set_title(attack)
    grid[-1, 0].set_xlabel(
        "% of the vehicles found without camouflage in that weather (bars: 95 % interval)"
    )
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=10)
    return as_files(figure)


def _panel(axes: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    lows = [0.0]
    for key, marker, colour, shift, label in _SERIES:
        drawn = {"color": colour, "markersize": 7, "markeredgecolor": "white"}
        for place, row in enumerate(rows):
            easr, low, high = row[key], row[f"{key}_low"], row[f"{key}_high"]
            y = place + shift
            if low == low:
                axes.plot([low, high], [y, y], color=colour, linewidth=2.2, solid_capstyle="butt")
                lows.append(low)
            if easr == easr:
                axes.plot(easr, y, marker, label=label if place == 0 else None, **drawn)
    names = [f"{_condition(row)}\nn = {row['vehicles']}" for row in rows]
    axes.set_yticks(range(len(rows)), names, fontsize=10)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    # Clear days above, all weathers together below, and between them each by itself.
    for place, row in enumerate(rows[1:], start=1):
        if place == 1 or row["condition"] == EVERY_WEATHER:
            axes.axhline(place - 0.5, color=GREY, linewidth=0.8, linestyle="--")
    axes.axvline(0, color=GREY, linewidth=1)
    axes.set_xlim(max(min(lows), -60) - 3, 103)
    rule(axes, "x")
