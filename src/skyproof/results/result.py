"""The table of results from counted outcomes, and one row of it."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from skyproof.camouflage.name import CamouflageName
from skyproof.ranges import Match
from skyproof.results.outcomes import MATCHES, ORIGINAL, OutcomeCounts, Series
from skyproof.results.rows_file import interval_columns, nulls_for_undefined
from skyproof.results.score_folder import SetScore
from skyproof.results.statistics.contrasts import (
    Group,
    control_p,
    difference_interval,
    holm,
    mean_interval,
    unchanged_p,
)
from skyproof.results.statistics.intervals import (
    UNDEFINED,
    Interval,
    Sample,
    attack_success_rate,
    enhancement_rate,
    overall_attack_success_rate,
)
from skyproof.seeds import numpy_generator

MEAN = "mean"
FROZEN = "frozen"
"""The operating point of the frozen threshold, which decides every verdict."""
MAIN_MATCH: Match = "centre_1m"
LENIENT_MATCH: Match = "centre_in_box"


@dataclass(frozen=True)
class Contrast:
    """A camouflage beside one of its controls, on the same tiles and vehicles.

    EASR and the number of draws are the control's; `net` is the camouflage's EASR minus it. `p` is
    the largest p-value of the tests against each draw (`control_p`), and `p_holm` is corrected over
    all camouflages of this detector; both are None if a detector found no vehicle before.
    """

    control: CamouflageName
    easr: float
    draws: int
    net: Interval
    p: float | None = None
    p_holm: float | None = None


@dataclass(frozen=True)
class Result:
    """The rates of one camouflage for one detector, or for the mean of all, by one match rule.

    Rates are fractions, nan where undefined, at one operating point (`EQUAL_ALARMS`, or the frozen
    threshold). False alarms are known at the frozen threshold alone. The spread of the repeats that
    share a result is nan for a single one.

    Attributes:
        clusters: number of background tiles that show any of the vehicles in sight.
        easr, asr, er: overall success, vehicles lost and vehicles gained.
        apd: drop of the average precision.
        random: contrast with the random control; None without one and for controls.
        strongest: contrast with the strongest of the chosen controls (`CHOICES`), of all draws of
            the random control and of the precheck's paints (`beside_paints`). The low limit is the
            lowest against any of them, so a claim holds against all; the p is the largest, paints
            excepted. None without a chosen control and for controls.
        drawn_shape: contrast of a combination with its own texture under random shapes.
        no_camouflage_p, no_camouflage_p_holm: McNemar's exact test against no camouflage, which
            random patterns can pass as well; None for means and controls.
        called_another_class: share of the vehicles found before on which only another class is
            detected, of the first repeat; nan but by the lenient rule, for detectors with others.
        found_before: share of the vehicles in sight that are found without camouflage.
    """

    camouflage: CamouflageName
    renderer: str
    detector: str
    match: str
    vehicles: int
    clusters: int
    repeats: int
    easr: Interval
    asr: Interval
    er: Interval
    easr_repeat_sd: float
    easr_repeat_min: float
    easr_repeat_max: float
    ap_original: float
    ap_adversarial: float
    apd: float
    false_alarms_per_km2_original: float
    false_alarms_per_km2_adversarial: float
    random: Contrast | None = None
    strongest: Contrast | None = None
    drawn_shape: Contrast | None = None
    no_camouflage_p: float | None = None
    no_camouflage_p_holm: float | None = None
    called_another_class: float = math.nan
    found_before: float = math.nan
    operating_point: str = FROZEN

    @property
    def key(self) -> tuple[CamouflageName, str, str, str]:
        """What tells the results of one operating point apart."""
        return self.camouflage, self.detector, self.renderer, self.match

    @property
    def net_easr(self) -> Interval | None:
        """EASR minus the mean EASR of the random control; None without one."""
        return None if self.random is None else self.random.net

    def json(self) -> dict[str, Any]:
        """Returns flat JSON values, as `results.json` holds them; undefined ones are None.

        The standard errors by source of variation (`easr_tile_se`, `easr_vehicle_se`,
        `easr_repeat_se`, `easr_threshold_se`, and `random_draw_se` of the net EASR) are None where
        the interval leaves that source out.
        """
        errors = self.easr.errors
        random = self.random or _NOTHING
        strongest = self.strongest or _NOTHING
        values: dict[str, Any] = {
            name: value
            for name, value in vars(self).items()
            if name not in _CONTRASTS and not isinstance(value, Interval)
        }
        return nulls_for_undefined(
            values
            | {"camouflage": str(self.camouflage)}
            | interval_columns("easr", self.easr)
            | interval_columns("asr", self.asr)
            | interval_columns("er", self.er)
            | {
                "easr_tile_se": errors.get("tiles"),
                "easr_vehicle_se": errors.get("vehicles"),
                "easr_repeat_se": errors.get("draws" if self.camouflage.random else "seeds"),
                "easr_threshold_se": errors.get("thresholds"),
                "random_draws": random.draws,
                "random_draw_se": random.net.errors.get("draws"),
                "strongest_control": str(strongest.control) if self.strongest else None,
            }
            | _columns(random, "random_easr", "net_easr", "control_p")
            | _columns(strongest, *_STRONGEST)
            | _columns(self.drawn_shape or _NOTHING, *_DRAWN_SHAPE)
        )


_CONTRASTS = ("random", "strongest", "drawn_shape")
_NOTHING = Contrast(CamouflageName("other"), math.nan, 0, UNDEFINED)
_STRONGEST = ("strongest_control_easr", "net_strongest_control_easr", "strongest_control_p")
_DRAWN_SHAPE = ("drawn_shape_easr", "net_drawn_shape_easr", "drawn_shape_p")


def _columns(contrast: Contrast, easr: str, net: str, p: str) -> dict[str, Any]:
    return {
        easr: contrast.easr,
        **interval_columns(net, contrast.net),
        p: contrast.p,
        f"{p}_holm": contrast.p_holm,
    }


def summarise(counts: OutcomeCounts, sets: Sequence[SetScore], *, seed: int) -> list[Result]:
    """Computes the results of a run from its counted outcomes, separately for each renderer.

    Repeats of one camouflage ("T-U-0", "T-U-1": seeds of an attack, draws of a control) share one
    result: the mean over repeats, and over detectors in result "mean" (unweighted; undefined where
    one detector found no vehicle before). All rates are on the same tiles and vehicles. The
    intervals cover which of these were drawn and, where there are several, which seeds, draws and
    thresholds. The `seed` is that of the resampling.

    Both tests give the largest p of the repeats, and 1 where these point both ways, so a claim
    holds for each of them. Holm's correction runs over the camouflages of one detector and match
    rule. A claim on all detectors takes the largest of their p, which needs no further correction.
    """
    rows: list[Result] = []
    scores = {Series(s.camouflage, s.renderer, s.detector, s.match): s for s in sets}
    known = {(key.renderer, key.match) for key in counts.series}
    for renderer in dict.fromkeys(key.renderer for key in counts.series):
        generator = numpy_generator(seed)
        for match in (each for each in MATCHES if (renderer, each) in known):
            here = counts.of(renderer, match)
            rows += _Table(here, scores, Sample.draw(here.cells, generator=generator)).rows()
    return _corrected(rows)


def _corrected(rows: list[Result]) -> list[Result]:
    """Adds Holm's correction, which needs all p-values of a family."""
    families: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for index, row in enumerate(rows):
        families[row.renderer, row.match, row.detector].append(index)
    for family in families.values():
        for field in _CONTRASTS:
            found = {index: getattr(rows[index], field) for index in family}
            tested = {index: each for index, each in found.items() if each and each.p is not None}
            corrected = holm([each.p for each in tested.values()])
            for (index, each), p_holm in zip(tested.items(), corrected, strict=True):
                change: dict[str, Any] = {field: replace(each, p_holm=p_holm)}
                rows[index] = replace(rows[index], **change)
        known = {i: p for i in family if (p := rows[i].no_camouflage_p) is not None}
        for index, p_holm in zip(known, holm(list(known.values())), strict=True):
            rows[index] = replace(rows[index], no_camouflage_p_holm=p_holm)
    return rows


class _Table:
    """Results of one renderer and one match rule."""

    def __init__(
        self, counts: OutcomeCounts, scores: Mapping[Series, SetScore], sample: Sample
    ) -> None:
        self.counts = counts
        self.sample = sample
        self.scores = scores
        self.key = next(iter(counts.series))
        self.series = {(key.camouflage, key.detector): each for key, each in counts.series.items()}
        self.detectors = dict.fromkeys(detector for _, detector in self.series)
        self.repeats: dict[CamouflageName, list[str]] = defaultdict(list)
        for camouflage in dict.fromkeys(name for name, _ in self.series):
            self.repeats[CamouflageName.read(camouflage).pooled].append(camouflage)
        self._groups: dict[tuple[tuple[str, ...], tuple[str, ...], bool], Group] = {}

    def rows(self) -> list[Result]:
        rows = []
        for name, members in self.repeats.items():
            present = [
                d for d in self.detectors if all((member, d) in self.series for member in members)
            ]
            rows += [self._row(name, detector, [detector]) for detector in present]
            if len(present) > 1:
                rows.append(self._row(name, MEAN, present))
        return rows

    def _row(self, name: CamouflageName, label: str, detectors: list[str]) -> Result:
        members = self.repeats[name]
        in_sight = self.series[members[0], detectors[0]][:, 0]
        group = self.group(members, detectors)
        totals = group.counts.sum(axis=1)
        of_repeats = overall_attack_success_rate(totals).reshape(len(members), -1).mean(axis=1)
        several = len(of_repeats) > 1
        found = group.counts[: len(detectors), :, :2].sum(axis=(1, 2))
        ap, alarms = "average_precision", "false_alarms_per_km2"
        ap_original = self._mean([ORIGINAL], detectors, ap)
        ap_adversarial = self._mean(members, detectors, ap)
        shape = name.random_shape
        untested = label == MEAN or name.random
        return Result(
            camouflage=name,
            renderer=self.key.renderer,
            detector=label,
            match=self.key.match,
            vehicles=int(in_sight.sum()),
            clusters=len(np.unique(self.sample.tile[in_sight > 0])),
            repeats=len(members),
            easr=mean_interval(group),
            asr=mean_interval(group, rate=attack_success_rate, limits=(0.0, 1.0)),
            er=mean_interval(group, rate=enhancement_rate, limits=(0.0, math.inf)),
            easr_repeat_sd=float(of_repeats.std(ddof=1)) if several else math.nan,
            easr_repeat_min=float(of_repeats.min()) if several else math.nan,
            easr_repeat_max=float(of_repeats.max()) if several else math.nan,
            ap_original=ap_original,
            ap_adversarial=ap_adversarial,
            apd=ap_original - ap_adversarial,
            false_alarms_per_km2_original=self._mean([ORIGINAL], detectors, alarms),
            false_alarms_per_km2_adversarial=self._mean(members, detectors, alarms),
            random=None if name.random else self._contrast(members, detectors, name.control),
            strongest=None if name.random else self._strongest(members, detectors, name),
            drawn_shape=None if shape is None else self._contrast(members, detectors, shape),
            no_camouflage_p=None if untested else unchanged_p(totals),
            called_another_class=self._mean(members[:1], detectors, "called_another_class"),
            found_before=float(found.mean()) / int(in_sight.sum()),
        )

    def _drawn(self, control: CamouflageName, detectors: list[str]) -> list[str]:
        """Lists the repeats of a control that were scored with all of these detectors."""
        repeats = self.repeats.get(control, [])
        return [draw for draw in repeats if all((draw, d) in self.series for d in detectors)]

    def group(self, camouflages: list[str], detectors: list[str], *, given: bool = False) -> Group:
        """Groups series, once for all results that use them."""
        wanted = (tuple(camouflages), tuple(detectors), given)
        if wanted not in self._groups:
            keys = [
                self.key._replace(camouflage=camouflage, detector=detector)
                for camouflage in camouflages
                for detector in detectors
            ]
            self._groups[wanted] = self.counts.group(keys, self.sample, given=given)
        return self._groups[wanted]

    def _mean(self, camouflages: list[str], detectors: list[str], field: str) -> float:
        """Returns the mean of a set score; nan where any of the sets was not scored."""
        known = [
            self.scores.get(self.key._replace(camouflage=camouflage, detector=detector))
            for camouflage in camouflages
            for detector in detectors
        ]
        values = [math.nan if score is None else getattr(score, field) for score in known]
        return float(np.mean(values))

    def _contrast(
        self, members: list[str], detectors: list[str], control: CamouflageName
    ) -> Contrast | None:
        """Contrasts a camouflage with all draws of one control; None if none was scored."""
        drawn = self._drawn(control, detectors)
        if not drawn:
            return None
        contrast = self._beside(members, detectors, control, drawn)
        return replace(contrast, p=self._p(members, detectors, drawn))

    def _beside(
        self, members: list[str], detectors: list[str], control: CamouflageName, drawn: list[str]
    ) -> Contrast:
        """Contrasts a camouflage with these draws of a control, without a test.

        A numbered control is one draw that stands for itself, so other draws add no spread.
        """
        group = self.group(drawn, detectors, given=control.repeat != "")
        net = difference_interval([self.group(members, detectors)], [group])
        return Contrast(control, group.rate, len(drawn), net)

    def _strongest(
        self, members: list[str], detectors: list[str], name: CamouflageName
    ) -> Contrast | None:
        """Contrasts a camouflage with its strongest control; limit and p hold for every control.

        Every draw of the random control enters by itself, as it may hide more than chosen controls.
        """
        every = {control: self._drawn(control, detectors) for control in name.chosen_controls}
        if not any(every.values()):
            return None
        drawn = self._drawn(name.control, detectors)
        every |= {CamouflageName.read(draw): [draw] for draw in drawn}
        found = [
            self._beside(members, detectors, control, draws)
            for control, draws in every.items()
            if draws
        ]
        best = max(found, key=lambda each: each.easr)
        low = float(np.min([each.net.low for each in found]))
        p = self._p(members, detectors, [draw for draws in every.values() for draw in draws])
        return replace(best, net=replace(best.net, low=low), p=p)

    def _p(self, members: list[str], detectors: list[str], drawn: list[str]) -> float | None:
        """Tests optimised against drawn camouflages; None if a detector found no vehicle before."""
        found = self.group(members, detectors).counts[: len(detectors), :, :2].sum(axis=(1, 2))
        if not all(found):
            return None

        def hidden(camouflage: str) -> Float[np.ndarray, " C"]:
            """Returns lost minus gained per tile, over what each detector found before."""
            tiles = self.sample.by_tile(self.group([camouflage], detectors).counts)
            return np.sum((tiles[..., 1] - tiles[..., 2]) / found[:, None], axis=0)

        return control_p(np.stack([*map(hidden, members)]), np.stack([*map(hidden, drawn)]))
