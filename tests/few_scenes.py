"""Commands that judge what they learn on few scenes, and choose controls from few."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_candidates
from skyproof.camouflage.name import CamouflageName

__all__ = ["few_scenes_judge"]

_CANDIDATES = 4


@contextmanager
def few_scenes_judge() -> Iterator[None]:
    """Within it, commands judge attacks and choices on eight batches of the attack's own size.

    Pictures of camouflages are coarse.

    Eight scenes each would take more than half of a tiny run's time, and of what is left to choose
    controls from 27 paints and 32 draws another half. `HeldOut` itself, as tests/attacks asks it,
    keeps its 64 scenes, and `make_candidates`, where a test has it from its module, all of them.
    """
    with ExitStack() as patches:
        patches.enter_context(patch("skyproof.attacks.held_out.BATCH_SIZE", 1))
        patches.enter_context(patch("skyproof.render.portrait._PORTRAIT_GSD_M", 0.1))
        patches.enter_context(patch("skyproof.camouflage.make.make_candidates", _few_candidates))
        yield


def _few_candidates(name: CamouflageName, draws: int, **options: Any) -> list[Camouflage]:
    return make_candidates(name, min(draws, _CANDIDATES), **options)[:_CANDIDATES]
