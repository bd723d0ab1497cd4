"""Query attacks: they use a detector's detections alone, without loss or gradient.

An evolution strategy (CMA-ES; Hansen, "The CMA evolution strategy: a tutorial", 2016) moves free
colours and shapes that were optimised on other detectors. Blocks of few colours, and controls from
a random draw, take random changes, and keep those that help.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from skyproof.attacks.held_out import HeldOut, at_a_time
from skyproof.attacks.objective import target_scores
from skyproof.attacks.settings import QuerySettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.folder import load_camouflage, read_record, save_camouflage
from skyproof.camouflage.make import Combination
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.detector import Detector
from skyproof.documents import check_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import alone
from skyproof.loop import Loop, refuse_other
from skyproof.randomness import generator_of
from skyproof.ranges import Fraction, Match
from skyproof.storage import weights_digest

_GOAL: Match = "centre_in_box"
"""A vehicle is hidden only if no detection finds it by this rule."""
_OTHER = "a search with other settings or from another start"
_SPREAD = 0.2
"""Standard deviation of the first candidates, whose values go from 0 to 1."""
MOST_NUMBERS = 60

# With as many images, a search of 48 numbers (4 x 4 fields) found nothing better than its start,
# and one of 12 numbers (4 bands) did: docs/attacks.md.
_TEXTURE_BANDS = 4
_SHAPE_BANDS = 8


class CoarseChange:
    """Offsets on bands across the cells of a texture (sRGB), or across the reach of a shape.

    The start is a finished camouflage and is not changed. In a combination, the shape moves.
    """

    def __init__(self, start: Camouflage) -> None:
        self._start = start
        moved = _moved(start)
        # A shape has one value per place.
        channels, bands = (len(moved), _TEXTURE_BANDS) if moved.ndim == 3 else (1, _SHAPE_BANDS)
        self.shape = (channels, max(1, min(bands, MOST_NUMBERS // channels)))
        self.count = math.prod(self.shape)

    def __call__(self, numbers: Float[np.ndarray, " K"]) -> Camouflage:
        """Returns the finished camouflage of some offsets; zeros give the start."""
        changed = copy.deepcopy(self._start)
        moved = _moved(changed)
        offsets = torch.as_tensor(numbers, dtype=moved.dtype).reshape(self.shape)
        rows = moved.shape[-2]
        band = ((torch.arange(rows) + 0.5) * self.shape[1] / rows).long()
        by_row = offsets[:, band].reshape(*moved.shape[:-1], 1).to(moved.device)
        with torch.no_grad():
            moved.add_(by_row)
        changed.project_()
        changed.finalise()
        return changed.requires_grad_(False)


def _moved(camouflage: Camouflage) -> nn.Parameter:
    part: nn.Module = camouflage.shape if isinstance(camouflage, Combination) else camouflage
    if isinstance(part, UniversalTexture) and not part.restricted:
        return part.cells
    if isinstance(part, DisplacementMap):
        return part.reach
    raise ConfigurationError(
        f"{camouflage.name} is neither a texture of free colours nor a shape, so there is nothing "
        "to move by degrees; give one that skyproof made."
    )


class _Evolution:
    """CMA-ES on coarse changes of a camouflage, from no change at all."""

    def __init__(self, start: Camouflage, seed: int) -> None:
        # It loads scipy.stats, which takes as long as some steps, and few commands need it.
        from cmaes import CMA

        self._change = CoarseChange(start)
        count = self._change.count
        bounds = np.tile([-1.0, 1.0], (count, 1))
        self._strategy = CMA(mean=np.zeros(count), sigma=_SPREAD, bounds=bounds, seed=seed % 2**32)
        self.candidates = self._strategy.population_size
        self._proposed: list[np.ndarray] = []

    def propose(self) -> list[Camouflage]:
        self._proposed = [self._strategy.ask() for _ in range(self.candidates)]
        return [self._change(numbers) for numbers in self._proposed]

    def learn(self, scores: Sequence[float]) -> None:
        """Takes the candidates' mean scores on the target; low is good."""
        self._strategy.tell(list(zip(self._proposed, scores, strict=True)))

    def best(self) -> Camouflage:
        """Returns the mean of the distribution, which many scenes moved; the best draw is luck."""
        return self._change(self._strategy.mean)


class _RandomChanges:
    """Keeps a random change if it lowers the score, as a search control does by losses."""

    candidates = 2

    def __init__(self, start: Camouflage, seed: int) -> None:
        self._camouflage = copy.deepcopy(start)
        self._other = self._camouflage
        self._seed = seed
        self._step = 0

    def propose(self) -> list[Camouflage]:
        """Returns the camouflage and one random change of it."""
        self._step += 1
        self._other = copy.deepcopy(self._camouflage)
        self._other.vary_(generator_of(self._seed, "search", self._step))
        return [self._camouflage, self._other]

    def learn(self, scores: Sequence[float]) -> None:
        if scores[1] < scores[0]:
            self._camouflage = self._other

    def best(self) -> Camouflage:
        return copy.deepcopy(self._camouflage)


def query_attack(
    start: Camouflage,
    detector: Detector,
    world: World,
    settings: QuerySettings,
    folder: str | Path,
    *,
    rival: Camouflage | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> Camouflage:
    """Optimises a camouflage by a detector's detections alone, within a budget of images.

    It lowers the mean over vehicles of the best score that finds the vehicle by the lenient rule (0
    without a detection), because a box that is merely moved does not hide it. The candidates of one
    generation share their scenes. A stopped attack continues from its last generation: detections
    are stored, and only those of the generation or the last comparison in which it stopped are
    queried again, beyond the budget. At the end start, result and rival are compared on scenes of
    no candidate, and the best one stays. These images count, too.

    Args:
        start: finished camouflage that was optimised on other detectors, or a random draw for a
            search control ("R-PixFc_search").
        detector: with its threshold.
        world: world of the attack.
        settings: budget, batch and seed.
        folder: gets `steps.jsonl`, and at the end the camouflage with the number of images in its
            record.
        rival: finished search control, which began from nothing and may have found more.
        on_step: called with (images shown, images in all).

    Returns:
        The finished camouflage, under the name of `start`.

    Raises:
        DetectorAnswerError: the detector stopped answering; the last checkpoint stays.
        ConfigurationError: it finds no vehicle in the scenes without camouflage, or the budget is
            too small for one generation.
        RunFolderError: the folder holds another search, or another process works there.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    identity = {
        "camouflage": str(start.name),
        "start_sha256": weights_digest(start),
        "detector": detector.name,
        "threshold": detector.threshold,
        "match": _GOAL,
        "settings": asdict(settings),
        "scenes": asdict(world.scenes),
        "rival_sha256": None if rival is None else weights_digest(rival),
    }
    if (folder / "camouflage.json").exists():
        return _finished(folder, identity)
    # Few colours leave nothing in between for an evolution to move through (docs/attacks.md).
    few_colours = isinstance(start, UniversalTexture) and start.restricted
    changes = few_colours or start.name.choice == "search"
    search = (_RandomChanges if changes else _Evolution)(start, settings.seed)
    held_out = HeldOut([detector], world, settings.seed, settings.batch_size, _GOAL)
    # Scenes without camouflage and with each compared one; a control has no start to return to.
    others = [each for each in (start, rival) if each is not None]
    compared = 0 if start.name.choice else (2 + len(others)) * held_out.scenes()
    per_step = search.candidates * settings.batch_size
    generations = (settings.images - compared) // per_step
    if generations < 1:
        raise ConfigurationError(
            f"{start.name} expects at least {compared + per_step} images to be queried, got "
            f"{settings.images}; allow more, or smaller batches."
        )
    total = generations * per_step + compared
    remedy = f"remove {folder} and search again"
    loop = Loop(folder, identity, generations, 1, {"start": start}, other=_OTHER, remedy=remedy)
    with alone(folder):
        if (folder / "camouflage.json").exists():
            return _finished(folder, identity)
        loop.resume()
        for row in loop.rows:
            # Seed and scores decide a search, so it is replayed rather than stored.
            search.propose()
            search.learn(_stored_scores(row, search.candidates, folder, remedy))
        for step in loop:
            scores = _try(search.propose(), detector, world, settings, step)
            search.learn(scores)
            images = step * per_step
            loop.report({"step": step, "images": images, "loss": min(scores), "scores": scores})
            for number in settings.keep_at:
                if images - per_step < number <= images:
                    kept = search.best()
                    kept.name = start.name.after_queries(number)
                    record = {"of": str(start.name), "images": images}
                    save_camouflage(folder / "snapshots" / str(kept.name), kept, record)
            if on_step is not None:
                on_step(images, total)
        found = search.best()
        queries: dict[str, Any] = {**identity, "images": total}
        if compared:
            measured = [held_out.measure(each) for each in (*others, found)]
            queries["judged"] = {
                "scenes": held_out.scenes(),
                "start_hides": measured[0].hidden,
                "rival_hides": measured[1].hidden if rival is not None else None,
                "hides": measured[-1].hidden,
            }
            # Of equal ones the first, which is the start.
            found = copy.deepcopy([*others, found][measured.index(max(measured))])
        found.name = start.name
        save_camouflage(folder, found, {"queries": queries})
        loop.forget()
    return found


def _finished(folder: Path, identity: Mapping[str, Any]) -> Camouflage:
    stored = read_record(folder).get("queries", {})
    refuse_other(folder, {key: stored.get(key) for key in identity}, identity, _OTHER)
    return load_camouflage(folder)


def _stored_scores(row: Mapping[str, Any], count: int, folder: Path, remedy: str) -> list[float]:
    """The scores in a row of `steps.jsonl`, checked."""
    place = f"{folder / 'steps.jsonl'}, scores"
    scores: list[float] = check_document(row.get("scores"), list[Fraction], place, remedy)
    if len(scores) != count:
        raise StoredFileError(f"{place} are {len(scores)} instead of {count}; {remedy}.")
    return scores


def _try(
    candidates: Sequence[Camouflage],
    detector: Detector,
    world: World,
    settings: QuerySettings,
    step: int,
) -> list[float]:
    """Shows the detector every candidate in the same scenes; returns mean scores on the target."""
    scenes = world.step_scenes(settings.batch_size, settings.seed, step)
    gsd_m = world.backgrounds.gsd_m

    @torch.no_grad()
    def show(candidate: Camouflage) -> float:
        frames = world.frames(candidate, scenes)
        return float(target_scores(detector, frames, gsd_m, _GOAL).mean())

    return at_a_time(show, candidates, [detector])
