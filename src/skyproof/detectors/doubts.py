"""What a detector's validation says against trusting any attack on it. Imports no torch."""

from __future__ import annotations

LEAST_AP = 0.2
"""Average precision (centre within 1 m) below which a detector is worth nothing.

Networks that were never trained reach 0.04 to 0.12 on images crowded with vehicles (one to four on
12 x 12 m), and boxes thrown at random 0.04 to 0.07. A detector worth attacking reaches 0.9.
"""

LEAST_VEHICLES = 50
"""Validation vehicles below which a threshold, and the recall it promises, are left to chance.

Of 50 vehicles a recall of 90 % is known to 8 points either way (95 %), of 5 to 26.
"""


def find_doubts(
    name: str, *, imported: bool, ap_centre_1m: float | None, vehicles: int | None
) -> list[str]:
    """Says in a sentence each what makes a frozen detector worth nothing; mostly nothing does.

    Args:
        name: of the detector.
        imported: whether it was trained elsewhere.
        ap_centre_1m: its average precision on its validation images, 0 to 1; None where not known.
        vehicles: how many there are in them; None where not known.
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
