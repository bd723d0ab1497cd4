"""Success by sun, tilt, heading, body type and weather: means over detectors and repeats."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from skyproof.results.outcomes import Outcome, count_cells, repeat_of
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample
from skyproof.words import body_name


@dataclass(frozen=True)
class Bin:
    """One condition: number of vehicles, each counted once, and their EASR."""

    label: str
    vehicles: int
    rate: Interval


@dataclass(frozen=True)
class Panel:
    """One small diagram: its bins, and the EASR of all vehicles together."""

    title: str
    bins: Sequence[Bin]
    overall: float


_HEADINGS = ((45, "towards sun\n(0–45°)"), (135, "across\n(45–135°)"), (181, "away\n(135–180°)"))


def condition_panels(outcomes: Sequence[Outcome], *, generator: np.random.Generator) -> list[Panel]:
    """Returns EASR by condition for the outcomes of one camouflage, renderer and match rule."""
    if not outcomes:
        return []
    labellers: list[tuple[str, Callable[[Outcome], str], list[str] | None]] = [
        _numeric("Sun above the horizon", outcomes, lambda o: o.sun_elevation_deg),
        _numeric("Camera off the vertical", outcomes, lambda o: o.tilt_deg),
        ("Vehicle's heading and the sun", _heading_label, [label for _, label in _HEADINGS]),
        ("Body type", lambda o: body_name(o.body_type).replace(" ", "\n"), None),
    ]
    if len({o.condition for o in outcomes}) > 1:
        labellers.append(
            ("Weather and light", lambda o: o.condition.replace("_", " ").replace(" ", "\n"), None)
        )
    overall = _rate(outcomes, generator).estimate
    panels = []
    for title, labeller, order in labellers:
        groups: dict[str, list[Outcome]] = {label: [] for label in order or ()}
        for outcome in outcomes:
            groups.setdefault(labeller(outcome), []).append(outcome)
        names = order or sorted(groups)
        bins = []
        for name in filter(groups.get, names):
            vehicles = len({(o.scene, o.placement) for o in groups[name]})
            bins.append(Bin(name, vehicles, _rate(groups[name], generator)))
        panels.append(Panel(title, bins, overall))
    return panels


def _numeric(
    title: str, outcomes: Sequence[Outcome], read: Callable[[Outcome], float]
) -> tuple[str, Callable[[Outcome], str], list[str]]:
    """Forms three bins of about equally many vehicles, cut at whole degrees for exact labels."""
    values = [read(outcome) for outcome in outcomes]
    ends = (math.floor(min(values)), math.ceil(max(values)))
    # If most values are alike, a cut may fall on an end and would leave an empty bin.
    cuts = sorted({round(float(cut)) for cut in np.quantile(values, [1 / 3, 2 / 3])} - {*ends})
    edges = [ends[0], *cuts, ends[1]]
    labels = [
        f"{low}–{high}°" if low < high else f"{low}°" for low, high in itertools.pairwise(edges)
    ]
    return (
        title,
        lambda outcome: labels[int(np.searchsorted(cuts, read(outcome), side="right"))],
        labels,
    )


def _heading_label(outcome: Outcome) -> str:
    return next(label for limit, label in _HEADINGS if outcome.heading_to_sun_deg < limit)


def _rate(outcomes: Sequence[Outcome], generator: np.random.Generator) -> Interval:
    (group,) = shared_groups([outcomes], generator=generator)
    return mean_interval(group)


def shared_groups(
    parts: Sequence[Sequence[Outcome]], *, generator: np.random.Generator
) -> list[Group]:
    """Groups the outcomes of several camouflages on one sample, by repeat and detector."""
    cells = sorted({(outcome.background, outcome.vehicle) for part in parts for outcome in part})
    row_of = {cell: row for row, cell in enumerate(cells)}
    sample = Sample.draw(cells, generator=generator)
    groups = []
    for part in parts:
        series: dict[tuple[str, str], list[Outcome]] = {}
        for outcome in part:
            series.setdefault((outcome.camouflage, outcome.detector), []).append(outcome)
        counts = np.stack([count_cells(each, row_of) for each in series.values()])
        groups.append(Group(counts, sample, [[repeat_of(name)] for name, _ in series]))
    return groups
