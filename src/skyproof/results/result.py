"""One row of the table of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.results.pairs.outcomes import Match
from skyproof.results.rows_file import nulls_for_undefined
from skyproof.results.statistics.intervals import Interval

MEAN = "mean"
MAIN_MATCH: Match = "centre_1m"
LENIENT_MATCH: Match = "centre_in_box"


@dataclass(frozen=True)
class Contrast:
    """A camouflage beside one of its controls, on the same tiles and vehicles.

    Attributes:
        control: the control's name without repeat.
        easr: of the control.
        draws: how many draws or repeats of the control.
        net: EASR of the camouflage minus that of the control.
        p, p_holm: of the test that it hides more than every draw (`control_p`): the largest, and
            Holm's correction over the camouflages that this detector judged; None where a detector
            found no vehicle before.
    """

    control: CamouflageName
    easr: float
    draws: int
    net: Interval
    p: float | None = None
    p_holm: float | None = None


@dataclass(frozen=True)
class Result:
    """One camouflage before one detector, or before the mean of all, by one match criterion.

    Rates are fractions, nan where undefined.

    Attributes:
        camouflage: its name without repeat; repeats of one camouflage share a row.
        renderer: who drew the images.
        detector: its name, or "mean".
        match: the criterion.
        vehicles: how many are in sight.
        clusters: background tiles that show vehicles.
        repeats: how many repeats share the row.
        easr, asr, er: overall success, vehicles lost and vehicles gained.
        easr_repeat_sd, easr_repeat_min, easr_repeat_max: how far the repeats lie apart; nan with
            one repeat.
        ap_original, ap_adversarial, apd: average precision before and after, and its drop.
        false_alarms_per_km2_original, false_alarms_per_km2_adversarial: at the frozen threshold.
        random: beside random draws of the same kind; None without them and for controls.
        unlearnt: beside the strongest of the controls that were chosen and not learnt, of those
            that were scored. Its interval begins at the lowest of the limits against each of them,
            and its p is the largest, so that what it claims holds against all; None without them
            and for controls.
        drawn_shape: of a combination, beside its own texture under random shapes; else None.
        no_camouflage_p, no_camouflage_p_holm: McNemar's exact test against no camouflage at all,
            which a random pattern passes, too; None for means and controls.
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

    @property
    def net_easr(self) -> Interval | None:
        """EASR minus that of random draws, the field's usual net figure; None without them."""
        return None if self.random is None else self.random.net

    def json(self) -> dict[str, Any]:
        """Gives flat JSON values, as `results.json` holds them; undefined ones are None.

        The standard errors by what was drawn (`easr_tile_se`, `easr_vehicle_se`, `easr_repeat_se`,
        and `random_draw_se` of the net EASR) are None where the interval leaves that out.
        """
        errors = self.easr.errors
        random = self.random or _NOTHING
        strongest = self.strongest or _NOTHING
        drawn_shape = self.drawn_shape or _NOTHING
        values = {
            "camouflage": str(self.camouflage),
            "renderer": self.renderer,
            "detector": self.detector,
            "vehicles": self.vehicles,
            "easr": self.easr.estimate,
            "easr_low": self.easr.low,
            "easr_high": self.easr.high,
            **_net("net_easr", random.net),
            "asr": self.asr.estimate,
            "er": self.er.estimate,
            "ap_original": self.ap_original,
            "ap_adversarial": self.ap_adversarial,
            "apd": self.apd,
            "match": self.match,
            "false_alarms_per_km2_original": self.false_alarms_per_km2_original,
            "false_alarms_per_km2_adversarial": self.false_alarms_per_km2_adversarial,
            "clusters": self.clusters,
            "repeats": self.repeats,
            "easr_repeat_sd": self.easr_repeat_sd,
            "easr_repeat_min": self.easr_repeat_min,
            "easr_repeat_max": self.easr_repeat_max,
            "asr_low": self.asr.low,
            "asr_high": self.asr.high,
            "er_low": self.er.low,
            "er_high": self.er.high,
            "random_easr": random.easr,
            "random_draws": random.draws,
            "easr_tile_se": errors.get("tiles"),
            "easr_vehicle_se": errors.get("vehicles"),
            "easr_repeat_se": errors.get("draws" if self.camouflage.random else "seeds"),
            "random_draw_se": random.net.errors.get("draws"),
            "control_p": random.p,
            "control_p_holm": random.p_holm,
            "strongest_control": str(strongest.control) if self.strongest else None,
            "strongest_control_easr": strongest.easr,
            **_net("net_strongest_control_easr", strongest.net),
            "strongest_control_p": strongest.p,
            "strongest_control_p_holm": strongest.p_holm,
            "drawn_shape_easr": drawn_shape.easr,
            **_net("net_drawn_shape_easr", drawn_shape.net),
            "drawn_shape_p": drawn_shape.p,
            "drawn_shape_p_holm": drawn_shape.p_holm,
            "no_camouflage_p": self.no_camouflage_p,
            "no_camouflage_p_holm": self.no_camouflage_p_holm,
        }
        return nulls_for_undefined(values)


@dataclass(frozen=True)
class Headline:
    """One camouflage under one renderer, by the main criterion.

    Attributes:
        camouflage, renderer: which it is.
        row: the row to quote: the mean over detectors, or the only detector's.
        by_detector: the detectors' rows, then the mean's where there is one.
        control: rows of its random control by detector.
        lenient: the row to quote, but by the lenient criterion, where half a vehicle finds the
            vehicle; None where nothing was scored by it.
    """

    camouflage: CamouflageName
    renderer: str
    row: Result
    by_detector: Sequence[Result]
    control: Mapping[str, Result]
    lenient: Result | None = None

    @property
    def detectors(self) -> list[str]:
        """The detectors that judged it."""
        return [row.detector for row in self.by_detector if row.detector != MEAN]


_UNDEFINED = float("nan")
_NOTHING = Contrast(
    CamouflageName("other"), _UNDEFINED, 0, Interval(_UNDEFINED, _UNDEFINED, _UNDEFINED)
)


def _net(name: str, interval: Interval) -> dict[str, float]:
    return {
        name: interval.estimate,
        f"{name}_low": interval.low,
        f"{name}_high": interval.high,
    }
