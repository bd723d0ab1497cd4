"""The figures of what was tested, as parts of the page."""

from __future__ import annotations

from skyproof.reproduction.cells import Block, Figure, Heading


def looks_section() -> list[Block]:
    """Names the figures; those that a run lacks are left out of its page."""
    return [
        Heading("What was tested"),
        Figure(
            "classes",
            "Kinds of vehicles in the test images; in brackets their share of all in sight",
        ),
        Figure(
            "samples",
            "The same test scenes as bare ground, with vehicles as built, and with the freest and "
            "the most constrained of the learnt textures, shapes and combinations",
        ),
        Figure(
            "sensor",
            "From the renderer’s samples to a photograph’s sharpness: one sample a pixel, four by "
            "four averaged, and blurred as the ground is",
        ),
        Figure(
            "maps",
            "Every learnt camouflage, of several repeats the first: its texture and its "
            "displacement (nose up, roof in the middle; brighter is farther out), where it has "
            "them, and worn, from above",
        ),
        Figure(
            "displacement",
            "A learnt displacement map and its axes of symmetry (dashed): the middle of the roof "
            "and of the underside, where the left border is the right one. Both lie in the plane "
            "that halves the vehicle lengthwise. Underside and wheels stay where they are, and "
            "what lies between vertices is not read: there the map holds what it began with",
        ),
    ]
