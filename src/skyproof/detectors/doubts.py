"""Reasons in a detector's validation not to trust any attack on it. Imports no torch."""

from __future__ import annotations

LEAST_AP = 0.2
"""Average precision (centre within 1 m) below which a detector is useless.

Untrained networks reach 0.04 to 0.12 on images crowded with vehicles (one to four on 12 x 12 m),
and random boxes 0.04 to 0.07. A detector that passes the precheck reaches 0.9.
"""

LEAST_VEHICLES = 50
"""Number of validation vehicles below which chance decides a threshold and its recall.

The 95 % interval of a recall of 90 % is 8 points either way for 50 vehicles, and 26 for 5.
"""


def find_doubts(
    name: str, *, imported: bool, ap_centre_1m: float | None, vehicles: int | None
) -> list[str]:
    """Lists the reasons that make a frozen detector useless, one sentence each; usually none.

    AP (0 to 1) and number of vehicles are those of its validation images; None if not known.
    """
    found = []
    if ap_centre_1m is not None and ap_centre_1m < LEAST_AP:
        remedy = (
            "check that the checkpoint was trained, and check --vehicle-classes and the metres per "
            "pixel that it was made for"
            if imported
            else "train it longer or on more images"
        )
        found.append(
            f"{name} reaches a validation AP of {ap_centre_1m:.3f}, and below {LEAST_AP:g} no "
            f"attack on it means anything; {remedy}."
        )
    if vehicles is not None and vehicles < LEAST_VEHICLES:
        found.append(
            f"The threshold of {name} was chosen on {vehicles} vehicles, and with fewer than "
            f"{LEAST_VEHICLES} chance decides it; give validation images with more."
        )
    return found
