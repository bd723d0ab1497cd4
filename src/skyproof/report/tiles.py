"""The tiles on which a verdict rests, with the scenes that they show."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from skyproof.camouflage.name import CamouflageName
from skyproof.results.outcomes import OutcomeCounts
from skyproof.results.precheck import PrecheckRecord
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER
from skyproof.results.statistics.acceptance import Tiles
from skyproof.scenes.scene import Scene
from skyproof.words import renderer_name


def attack_tiles(counts: OutcomeCounts, detector: str, scenes: Sequence[Scene]) -> dict[str, Tiles]:
    """Returns found and lost vehicles per tile, by camouflage and renderer."""
    names, place = np.unique([tile for tile, _ in counts.cells], return_inverse=True)
    attacks = {}
    for key, own in counts.series.items():
        camouflage = CamouflageName.read(key.camouflage)
        single_draw = camouflage.random and not camouflage.choice
        other = (key.detector, key.match) != (detector, MAIN_MATCH)
        if other or single_draw or camouflage.kept_copy:
            continue
        by_tile = np.zeros((len(names), 4), dtype=np.int64)
        np.add.at(by_tile, place, own)
        _, both, lost, _ = by_tile.T
        shown = key.camouflage
        if key.renderer != RENDERER:
            shown += f" on {renderer_name(key.renderer)}"
        attacks[shown] = _tiles(names.tolist(), both + lost, lost, scenes)
    return attacks


def paint_tiles(precheck: PrecheckRecord, scenes: Sequence[Scene]) -> dict[str, Tiles]:
    """Returns found and lost vehicles per tile, of each paint that failed the precheck."""
    checked = scenes[: precheck.measured_on.scenes]
    names = sorted({scene.background.tile for scene in checked if scene.placements})
    paints = precheck.failed_paints()
    return {paint: _tiles(names, *counted, checked) for paint, counted in paints.items()}


def _tiles(
    names: Sequence[str],
    found: Int[np.ndarray, " C"],
    lost: Int[np.ndarray, " C"],
    scenes: Sequence[Scene],
) -> Tiles:
    """Adds each tile's scenes; if unknown, each tile is one scene as full as the fullest tile."""
    on_tile = Counter(scene.background.tile for scene in scenes)
    most = max((len(scene.placements) for scene in scenes), default=0)
    number = np.array([on_tile[name] for name in names], dtype=np.int64)
    if len(number) == len(found) and number.all() and not np.any(found > number * most):
        return Tiles(number, found, lost, most)
    return Tiles(np.ones_like(found), found, lost, int(found.max()))
