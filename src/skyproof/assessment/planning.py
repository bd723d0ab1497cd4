"""What an assessment would take, and what its test could decide: said before it is begun."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from skyproof.assessment.run import Step, duration
from skyproof.assessment.subject import Subject
from skyproof.results.statistics.acceptance import fewest_tiles
from skyproof.results.statistics.planning import (
    Assumptions,
    expected_half_width,
    tiles_needed,
    tiles_to_decide,
    tiles_to_show,
)
from skyproof.words import percent

_VEHICLES = 3
"""Mean number in a test scene."""
_EASR = 0.8
_CORRELATION = 0.1
"""Assumed correlation of vehicles on one tile."""
_HALF_WIDTH = 0.05


def plan_words(its: Subject, tiles: int, steps: Sequence[Step]) -> Iterator[str]:
    """Tells the size of a test on at most so many tiles, the size it needs, and the time."""
    scenes = its.suite.test_images
    # Scenes fall on tiles at random, so that some tiles are seen twice and some never.
    shown = max(1, round(tiles * (1 - (1 - 1 / max(tiles, 1)) ** scenes)))
    each = max(_VEHICLES * scenes / shown, 1.0)
    effect = 1 + max(each - 1, 0) * _CORRELATION
    fleet = its.suite.vehicles[3]
    assumptions = Assumptions(_EASR, vehicles_per_tile=each, design_effect=effect, fleet=fleet)
    width = expected_half_width(shown, assumptions)
    yield (
        f"Test: {scenes} scenes with about {_VEHICLES * scenes} vehicles on {shown} of "
        f"{'at most ' if its.request.imagery else ''}{tiles} test tiles. The 95 % interval of an "
        f"EASR of {percent(_EASR)} would be about ±{100 * width:.0f} percentage points."
    )
    needed = tiles_needed(_HALF_WIDTH, assumptions)
    if needed is not None:
        yield f"For ±{100 * _HALF_WIDTH:.0f} points it takes about {needed:,} such tiles."
    requirement = its.request.requirement
    if requirement is not None:
        fewest = fewest_tiles(requirement.reject, requirement.consumer_risk)
        decides = tiles_to_decide(requirement, assumptions)
        verdict = "enough" if shown >= fewest else "too few"
        yield (
            f"Requirement: no verdict is possible on fewer than {fewest} tiles that scenes stand "
            f"on ({shown} are {verdict}), which takes about {tiles_to_show(fewest, scenes):,} "
            f"test tiles. On about {decides:,}, nine of ten tests decide it."
        )
    effort_s = math.fsum(step.effort_s for step in steps)
    yield f"Time: {len(steps)} steps, about {duration(effort_s)} on one CPU core."
