"""By another rule of what is found, and what the detectors report where nothing is."""

import math
from typing import Any

from skyproof.reproduction.cells import TextTable, Topic, interval_cells, number, rate, value
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.result import LENIENT_MATCH
from skyproof.words import detector_name

_OVERLAP = "iou_50"
_LENIENT = f"easr_{LENIENT_MATCH}"


def criteria_part(run: Reproduction) -> Topic:
    """Gives every learnt camouflage's EASR by each rule, and the false alarms, mean of detectors.

    Attacks that end on the way or see some detectors only are left out.
    """
    rows: list[dict[str, Any]] = []
    for camouflage in run.results.names:
        centre = run.results.row(camouflage)
        if camouflage.random or camouflage.variant or centre is None:
            continue
        row = {"attack": str(camouflage), **interval_cells("easr", centre.easr, 100.0)}
        if overlap := run.results.row(camouflage, match=_OVERLAP):
            row |= interval_cells("easr_iou_50", overlap.easr, 100.0)
            row["ap_iou_50_original"] = 100 * overlap.ap_original
            row["ap_iou_50_adversarial"] = 100 * overlap.ap_adversarial
        if lenient := run.results.row(camouflage, match=LENIENT_MATCH):
            row |= interval_cells(_LENIENT, lenient.easr, 100.0)
        for when in ("original", "adversarial"):
            name = f"false_alarms_per_km2_{when}"
            row[name] = getattr(centre, name)
        rows.append(row)
    text = (
        "Above, a vehicle counts as found where a detection’s centre lies within 1 m of its own; "
        "here also where the boxes’ intersection over union is at least 0.5, and leniently where "
        "the detection’s centre lies anywhere in the vehicle’s box. False alarms are "
        "detections on no vehicle at the frozen threshold, per square kilometre of test ground, "
        "beside vehicles without and with the camouflage."
    )
    grid = TextTable.of(
        rows,
        [
            ("attack", "attack"),
            ("EASR", rate("easr")),
            ("EASR, IoU ≥ 0.5", rate("easr_iou_50")),
            ("EASR, centre in box", rate(_LENIENT)),
            ("AP, IoU ≥ 0.5", value("ap_iou_50_original")),
            ("AP then", value("ap_iou_50_adversarial")),
            ("false alarms per km²", value("false_alarms_per_km2_original", 0)),
            ("then", value("false_alarms_per_km2_adversarial", 0)),
        ],
    )
    heading = "By overlap, and false alarms"
    return Topic.of(heading, {"criteria": rows}, text, grid, _on_empty_ground(run))


def _on_empty_ground(run: Reproduction) -> str:
    """Says what is found on images without vehicles; nothing where none were shown."""
    found = [
        f"{detector_name(check.detector)} {number(check.false_alarms_per_km2, 0)}"
        for check in run.results.baselines
        if not check.vehicles and not math.isnan(check.false_alarms_per_km2)
    ]
    if not found:
        return ""
    return f"On test ground without vehicles, false alarms per km²: {', '.join(found)}."
