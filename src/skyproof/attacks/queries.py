"""Attacks that know a detector's answers and nothing else: no loss, no gradient.

They begin at a camouflage that was learnt on other detectors. An evolution strategy (CMA-ES;
Hansen, "The CMA evolution strategy: a tutorial", 2016) moves free colours and shapes; blocks of few
colours take random changes, of which those are kept that help. A random search from a random draw
is the control beside either.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cmaes import CMA

from skyproof.attacks.coarse import CoarseChange
from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.objective import target_scores
from skyproof.attacks.settings import QuerySettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage, read_record, save_camouflage
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.detector import Detector
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.weights import weights_digest
from skyproof.documents import check_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import alone
from skyproof.loop import Loop, refuse_other
from skyproof.randomness import generator_of
from skyproof.ranges import Fraction

_OTHER = "a search with other settings or from another start"
_SPREAD = 0.2
"""Standard deviation of the first candidates, of values that go from 0 to 1."""


class _Evolution:
    """CMA-ES on coarse changes of a camouflage, from no change at all."""

    def __init__(self, start: Camouflage, seed: int) -> None:
        self._change = CoarseChange(start)
        count = self._change.count
        self._strategy = CMA(
            mean=np.zeros(count),
            sigma=_SPREAD,
            bounds=np.tile([-1.0, 1.0], (count, 1)),
            seed=seed % 2**32,
        )
        self.candidates = self._strategy.population_size
        self._asked: list[np.ndarray] = []

    def ask(self) -> list[Camouflage]:
        """Gives as many candidates as `candidates` says, to be tried."""
        self._asked = [self._strategy.ask() for _ in range(self.candidates)]
        return [self._change(numbers) for numbers in self._asked]

    def tell(self, scores: Sequence[float]) -> None:
        """Takes the candidates' mean scores on the target; low is good."""
        self._strategy.tell(list(zip(self._asked, scores, strict=True)))

    def best(self) -> Camouflage:
        """Gives the middle of the distribution, which many scenes moved; a lucky draw is noise."""
        return self._change(self._strategy.mean)


class _RandomChanges:
    """Keeps a random change where it lowers the score, as `search_step` does by losses."""

    candidates = 2

    def __init__(self, start: Camouflage, seed: int) -> None:
        self._camouflage = copy.deepcopy(start)
        self._other = self._camouflage
        self._seed = seed
        self._step = 0

    def ask(self) -> list[Camouflage]:
        """Gives the camouflage and one random change of it."""
        self._step += 1
        self._other = copy.deepcopy(self._camouflage)
        self._other.vary_(generator_of(self._seed, "search", self._step))
        return [self._camouflage, self._other]

    def tell(self, scores: Sequence[float]) -> None:
        """Takes the mean scores of both."""
        if scores[1] < scores[0]:
            self._camouflage = self._other

    def best(self) -> Camouflage:
        """Gives what was kept."""
        return copy.deepcopy(self._camouflage)


_Search = _Evolution | _RandomChanges


def query_attack(
    start: Camouflage,
    judge: LoadedDetector[Detector],
    world: World,
    settings: QuerySettings,
    folder: str | Path,
    *,
    on_step: Callable[[int, int], None] | None = None,
) -> Camouflage:
    """Seeks a camouflage by a detector's answers alone, within a budget of images.

    What is lowered is the mean over vehicles of the best score that the detector gives within 1 m
    of the vehicle (0 where it gives none). Candidates of one generation are shown in the same
    scenes, those of the next in others. A stopped search goes on from its last generation: what the
    detector answered is stored, and only the answers of the generation or of the last judgement
    that it stopped in are asked for again, beyond the budget. At the end start and result are shown
    the same scenes that no candidate was tried on, and the better one stays; so a search is never a
    step back. These images count, too.

    Args:
        start: finished: what was learnt on other detectors; of a control that is to be searched for
            ("R-PixFc_search") a random draw.
        judge: a detector with the threshold that counts.
        world: what an attack sees; its ground and vehicles are no test's.
        settings: budget, batch and seed.
        folder: gets `steps.jsonl`, and at the end the camouflage (see `save_camouflage`), its
            record saying how many images were asked.
        on_step: called with (images shown, images in all).

    Returns:
        The camouflage, finished; under the name of `start`.

    Raises:
        DetectorAnswerError: the detector stopped answering; the last checkpoint stays.
        ConfigurationError: it finds no vehicle of the scenes without camouflage, or the budget is
            too small for one generation.
        RunFolderError: the folder holds another search, or somebody else works there.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    identity = {
        "camouflage": str(start.name),
        "start_sha256": weights_digest(start),
        "detector": judge.name,
        "threshold": judge.threshold,
        "settings": asdict(settings),
        "scenes": asdict(world.scenes),
    }
    if (folder / "camouflage.json").exists():
        return _finished(folder, identity)
    search = _search(start, settings)
    held_out = HeldOut([judge], world, settings.seed, settings.batch_size)
    # Without camouflage, in the start and in the result; a control has no start to fall back on.
    judged = 0 if start.name.choice else 3 * held_out.scenes()
    each = search.candidates * settings.batch_size
    generations = (settings.images - judged) // each
    if generations < 1:
        raise ConfigurationError(
            f"{start.name} expects at least {judged + each} images to be asked, got "
            f"{settings.images}; allow more, or smaller batches."
        )
    loop = Loop(
        folder,
        identity,
        generations,
        1,
        {"start": start},
        other=_OTHER,
        remedy=f"remove {folder} and search again",
    )
    with alone(folder):
        if (folder / "camouflage.json").exists():
            return _finished(folder, identity)
        loop.resume()
        for row in loop.rows:
            # A search is decided by its seed and by what it was told.
            search.ask()
            search.tell(_told(row, search.candidates, folder))
        for step in loop:
            scores = _try(search.ask(), judge, world, settings, step)
            search.tell(scores)
            images = step * each
            loop.report({"step": step, "images": images, "loss": min(scores), "scores": scores})
            _keep(search, start, settings, folder, images, each)
            if on_step is not None:
                on_step(images, generations * each + judged)
        found = search.best()
        found.name = start.name
        asked: dict[str, Any] = {**identity, "images": generations * each + judged}
        if not start.name.choice:
            found, hidden = _better(start, found, held_out)
            asked["judged"] = hidden
        save_camouflage(folder, found, {"queries": asked})
        loop.forget()
    return found


def _finished(folder: Path, identity: Mapping[str, Any]) -> Camouflage:
    asked = read_record(folder).get("queries", {})
    refuse_other(folder, {key: asked.get(key) for key in identity}, identity, _OTHER)
    return load_camouflage(folder)


def _told(row: Mapping[str, Any], count: int, folder: Path) -> list[float]:
    """What a row of `steps.jsonl` says that the detector answered.

    Raises:
        StoredFileError: it says something else.
    """
    place = f"{folder / 'steps.jsonl'}, scores"
    remedy = f"remove {folder} and search again"
    scores: list[float] = check_document(row.get("scores"), list[Fraction], place, remedy)
    if len(scores) != count:
        raise StoredFileError(f"{place} are {len(scores)} instead of {count}; {remedy}.")
    return scores


def _search(start: Camouflage, settings: QuerySettings) -> _Search:
    # Few colours leave nothing in between for an evolution to move through (docs/attacks.md).
    few_colours = isinstance(start, UniversalTexture) and start.restricted
    changes = few_colours or start.name.choice == "search"
    return (_RandomChanges if changes else _Evolution)(start, settings.seed)


@torch.no_grad()
def _try(
    candidates: Sequence[Camouflage],
    judge: LoadedDetector[Detector],
    world: World,
    settings: QuerySettings,
    step: int,
) -> list[float]:
    """Shows the detector every candidate in the same scenes; returns mean scores on the target."""
    scenes = world.step_scenes(settings.batch_size, settings.seed, step)
    means = []
    for candidate in candidates:
        frames = world.frames(candidate, scenes)
        scores = target_scores(judge.detector, frames, world.backgrounds.gsd_m)
        means.append(float(scores.mean()))
    return means


def _better(
    start: Camouflage, found: Camouflage, held_out: HeldOut
) -> tuple[Camouflage, dict[str, Any]]:
    """Chooses between what was found and what it started from, on scenes of neither."""
    before = held_out.judge(start)
    after = held_out.judge(found)
    hidden = {"scenes": held_out.scenes(), "start_hides": before.hidden, "hides": after.hidden}
    return (found if after > before else start), hidden


def _keep(
    search: _Search,
    start: Camouflage,
    settings: QuerySettings,
    folder: Path,
    images: int,
    each: int,
) -> None:
    """Stores a copy of what was found by now, where this step passed a number of `keep_at`."""
    for number in settings.keep_at:
        if images - each < number <= images:
            kept = search.best()
            kept.name = start.name.asked(number)
            record = {"of": str(start.name), "images": images}
            save_camouflage(folder / "snapshots" / str(kept.name), kept, record)
