"""A row of results where only what a test is about is given."""

from skyproof.camouflage.name import CamouflageName
from skyproof.results.rows import Row
from skyproof.results.statistics.intervals import Interval

NAN = float("nan")
UNKNOWN = Interval(NAN, NAN, NAN)


def made_row(camouflage, detector, **given):
    values = dict.fromkeys(
        [
            "easr_repeat_sd",
            "easr_repeat_min",
            "easr_repeat_max",
            "ap_original",
            "ap_adversarial",
            "apd",
            "false_alarms_per_km2_original",
            "false_alarms_per_km2_adversarial",
        ],
        NAN,
    )
    values |= dict.fromkeys(("vehicles", "clusters", "repeats", "random_draws"), 1)
    values |= dict.fromkeys(("easr", "asr", "er"), UNKNOWN)
    values |= {"renderer": "torch", "match": "centre_1m", "net_easr": None, "random_easr": None}
    return Row(CamouflageName.read(camouflage), detector=detector, **{**values, **given})
