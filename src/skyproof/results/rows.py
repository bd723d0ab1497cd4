"""One row of the table of results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.results.rows_file import nulls_for_undefined
from skyproof.results.statistics.intervals import Interval

__all__ = ["MAIN_MATCH", "MEAN", "Row"]

MEAN = "mean"
MAIN_MATCH = "centre_1m"


@dataclass(frozen=True)
class Row:
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
        net_easr: EASR minus that of the random control; None without a control.
        random_easr: EASR of the random control; None without one.
        random_draws: of the control.
        easr_repeat_sd, easr_repeat_min, easr_repeat_max: how far the repeats lie apart; nan with
            one repeat.
        ap_original, ap_adversarial, apd: average precision before and after, and its drop.
        false_alarms_per_km2_original, false_alarms_per_km2_adversarial: at the frozen threshold.
        control_p, control_p_holm: learnt against every draw of its control on the same vehicles
            (`control_p`): the largest p, and Holm's correction over the camouflages that this
            detector judged; None for controls and without one.
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
    net_easr: Interval | None
    random_easr: float | None
    random_draws: int
    easr_repeat_sd: float
    easr_repeat_min: float
    easr_repeat_max: float
    ap_original: float
    ap_adversarial: float
    apd: float
    false_alarms_per_km2_original: float
    false_alarms_per_km2_adversarial: float
    control_p: float | None = None
    control_p_holm: float | None = None
    no_camouflage_p: float | None = None
    no_camouflage_p_holm: float | None = None

    def json(self) -> dict[str, Any]:
        """Gives flat JSON values, as `results.json` holds them; undefined ones are None.

        The standard errors by what was drawn (`easr_tile_se`, `easr_vehicle_se`, `easr_repeat_se`,
        and `random_draw_se` of the net EASR) are None where the interval leaves that out.
        """
        errors = self.easr.errors
        net = self.net_easr or Interval(float("nan"), float("nan"), float("nan"))
        values = {
            "camouflage": str(self.camouflage),
            "renderer": self.renderer,
            "detector": self.detector,
            "vehicles": self.vehicles,
            "easr": self.easr.estimate,
            "easr_low": self.easr.low,
            "easr_high": self.easr.high,
            "net_easr": net.estimate,
            "net_easr_low": net.low,
            "net_easr_high": net.high,
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
            "random_easr": self.random_easr,
            "random_draws": self.random_draws,
            "easr_tile_se": errors.get("tiles"),
            "easr_vehicle_se": errors.get("vehicles"),
            "easr_repeat_se": errors.get("draws" if self.camouflage.random else "seeds"),
            "random_draw_se": net.errors.get("draws"),
            "control_p": self.control_p,
            "control_p_holm": self.control_p_holm,
            "no_camouflage_p": self.no_camouflage_p,
            "no_camouflage_p_holm": self.no_camouflage_p_holm,
        }
        return nulls_for_undefined(values)
