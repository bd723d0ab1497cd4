"""A row of results where only what a test is about is given."""

from skyproof.camouflage.name import CamouflageName
from skyproof.results.result import Contrast, Result
from skyproof.results.statistics.intervals import Interval

NAN = float("nan")
UNKNOWN = Interval(NAN, NAN, NAN)


def beside(control, easr, net, draws=1):
    return Contrast(CamouflageName.read(control), easr, draws, net)


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
    values |= dict.fromkeys(("vehicles", "clusters", "repeats"), 1)
    values |= dict.fromkeys(("easr", "asr", "er"), UNKNOWN)
    values |= {"renderer": "torch", "match": "centre_1m"}
    return Result(CamouflageName.read(camouflage), detector=detector, **{**values, **given})
