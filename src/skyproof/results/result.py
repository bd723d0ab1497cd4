"""One row of the table of results."""

import math
from dataclasses import dataclass
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.results.pairs.outcomes import Match
from skyproof.results.rows_file import interval_columns, nulls_for_undefined
from skyproof.results.statistics.intervals import UNDEFINED, Interval

MEAN = "mean"
MAIN_MATCH: Match = "centre_1m"
LENIENT_MATCH: Match = "centre_in_box"


@dataclass(frozen=True)
class Contrast:
    """A camouflage beside one of its controls, on the same tiles and vehicles.

    Attributes:
        easr, draws: EASR of the control, and the number of its draws or repeats.
        net: EASR of the camouflage minus that of the control.
        p, p_holm: largest p of the test that the camouflage hides more than each draw
            (`control_p`), and Holm's correction over all camouflages of this detector; None if a
            detector found no vehicle before.
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

    Rates are fractions, nan where undefined. False alarms are at the frozen threshold. The spread
    of the repeats that share a result is nan for a single one.

    Attributes:
        camouflage: name without repeat.
        vehicles, clusters: numbers of vehicles in sight, and of background tiles that show any.
        easr, asr, er: overall success, vehicles lost and vehicles gained.
        ap_original, ap_adversarial, apd: average precision before and after, and its drop.
        random: contrast with the random control; None without one and for controls.
        strongest: contrast with the strongest of the plain-paint, best-of-N and search controls.
            The low limit is the lowest against any of them and the p the largest, so a claim holds
            against all. None without such controls and for controls.
        drawn_shape: contrast of a combination with its own texture under random shapes.
        no_camouflage_p, no_camouflage_p_holm: McNemar's exact test against no camouflage, which
            random patterns can pass as well; None for means and controls.
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
        """EASR minus the mean EASR of the random control; None without one."""
        return None if self.random is None else self.random.net

    def json(self) -> dict[str, Any]:
        """Gives flat JSON values, as `results.json` holds them; undefined ones are None.

        The standard errors by source of variation (`easr_tile_se`, `easr_vehicle_se`,
        `easr_repeat_se`, and `random_draw_se` of the net EASR) are None where the interval leaves
        that source out.
        """
        errors = self.easr.errors
        random = self.random or _NOTHING
        strongest = self.strongest or _NOTHING
        values: dict[str, Any] = {
            name: value
            for name, value in vars(self).items()
            if not isinstance(value, Interval | Contrast | None)
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
                "random_draws": random.draws,
                "random_draw_se": random.net.errors.get("draws"),
                "strongest_control": str(strongest.control) if self.strongest else None,
            }
            | _columns(random, "random_easr", "net_easr", "control_p")
            | _columns(strongest, *_STRONGEST)
            | _columns(self.drawn_shape or _NOTHING, *_DRAWN_SHAPE)
            | {
                "no_camouflage_p": self.no_camouflage_p,
                "no_camouflage_p_holm": self.no_camouflage_p_holm,
            }
        )


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
