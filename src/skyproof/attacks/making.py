"""Makes camouflages by name, each in a folder of its own: drawn, chosen, or optimised."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from scipy import special
from torch import Tensor

from skyproof.attacks import held_out
from skyproof.attacks.attack import add_gradients, attack, attack_weights, descend, make_optimiser
from skyproof.attacks.objective import frozen, target_scores
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage import make
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import read_record, save_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.console import progress_bar
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.errors import NotFiniteError
from skyproof.files import drop_empty_folder, finished_folder
from skyproof.loop import refuse_other
from skyproof.randomness import generator_of
from skyproof.storage import weights_digest

_FIRST_BATCHES = 2
_FINALISTS = 4
"""One candidate in four is tried on all scenes."""


def draw_random_control(
    name: CamouflageName,
    folder: Path,
    *,
    seed: int,
    palette: Float[Tensor, "colours 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> None:
    """Draws a random control (section 5.4) into a folder, from arguments of `make_camouflage`."""
    settings = settings or CamouflageSettings()
    drawn = {
        "seed": seed,
        **_constraints(name, palette, settings),
        "texture_sha256": None if texture is None else weights_digest(texture),
    }
    if not _is_made(folder, "drawn", drawn):
        given = {"palette": palette, "texture": texture, "settings": settings}
        _store(folder, make.draw_control(name, seed=seed, **given), {"seed": seed, "drawn": drawn})


@dataclass(frozen=True)
class Maker:
    """Makes camouflages against detectors in one world; Fc, Lc and Pix take a palette."""

    detectors: Sequence[Detector]
    world: World
    settings: AttackSettings
    device: torch.device
    palette: Float[Tensor, "colours 3"] | None = None
    camouflage: CamouflageSettings = field(default_factory=CamouflageSettings)

    def make(
        self, name: CamouflageName, folder: Path, *, draws: int, texture: Camouflage | None
    ) -> None:
        """Chooses a control, from `draws` for best-of-N, or optimises; shows a progress bar."""
        with progress_bar(f"{'choose' if name.has_candidates else 'attack'} {name}") as update:
            if name.has_candidates:
                self._choose(name, folder, draws, update)
            else:
                self._optimise(name, folder, texture, update)

    def _choose(
        self, name: CamouflageName, folder: Path, draws: int, progress: Callable[[int, int], None]
    ) -> None:
        seed, scenes = self.settings.seed, self._held_out
        by = {
            "detectors": scenes.identity,
            "scenes": asdict(self.world.scenes),
            "world_sha256": self.world.digest,
            "seed": seed,
            "draws": None if name.choice == "plain" else draws,
            **_constraints(name, self.palette, self.camouflage),
            "texture_sha256": None,
        }
        if not _is_made(folder, "by", by):
            candidates = make.make_candidates(
                name, draws, seed=seed, palette=self.palette, settings=self.camouflage
            )
            moved = [candidate.to(self.device) for candidate in candidates]
            chosen, record = choose(moved, scenes, progress=progress)
            chosen.name = name
            _store(folder, chosen, {"chosen": {**record, "seed": seed}, "by": by})

    def _optimise(
        self,
        name: CamouflageName,
        folder: Path,
        texture: Camouflage | None,
        progress: Callable[[int, int], None],
    ) -> None:
        """Attacks the detectors after a sign test of the gradient, or searches without one."""
        camouflage = make.make_camouflage(
            name,
            generator=generator_of(self.settings.seed, "texture", str(name)),
            palette=self.palette if self.settings.takes_palette(name) else None,
            texture=texture,
            settings=self.camouflage,
        ).to(self.device)
        models = [each for each in self.detectors if isinstance(each, TrainableDetector)]
        settings = self.settings.of_search() if name.random else self.settings

        def signs() -> dict[str, Any]:
            return {"sign_test": sign_test(camouflage, models, self.world, settings)}

        attack(
            camouflage,
            models,
            self.world,
            settings,
            folder,
            held_out=self._held_out,
            record=None if name.random else signs,
            on_step=lambda row: progress(row["step"], settings.steps),
        )

    @cached_property
    def _held_out(self) -> held_out.HeldOut:
        batch_size = max(held_out.BATCH_SIZE, self.settings.batch_size)
        return held_out.HeldOut(self.detectors, self.world, self.settings.seed, batch_size)


def choose(
    candidates: Sequence[Camouflage], scenes: held_out.HeldOut, progress: Callable[[int, int], None]
) -> tuple[Camouflage, dict[str, Any]]:
    """Chooses the camouflage that hides most vehicles on held-out scenes, mean over detectors.

    All are tried on a quarter of the scenes, the best quarter of them on all; lower scores on the
    targets decide between equals. Returns the best, and the choice as JSON values.
    """
    first = []
    for number, candidate in enumerate(candidates):
        progress(number, len(candidates))
        first.append(scenes.measure(candidate, _FIRST_BATCHES))
    ranked = sorted(range(len(candidates)), key=lambda number: first[number], reverse=True)
    finalists = ranked[: math.ceil(len(candidates) / _FINALISTS)]
    final = {number: scenes.measure(candidates[number]) for number in finalists}
    names = [str(candidate.name) for candidate in candidates]
    return candidates[max(finalists, key=lambda number: final[number])], {
        "of": names,
        "hidden": [found.hidden for found in first],
        "scenes": scenes.scenes(_FIRST_BATCHES),
        "finalists": {names[number]: found.hidden for number, found in final.items()},
        "final_scenes": scenes.scenes(),
    }


def sign_test(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
) -> dict[str, dict[str, Any]]:
    """Takes one step of the attack's own optimiser, and compares the scores on the step's vehicles.

    Each of the `balance_batches` begins anew, on scenes of no step. "p" is the one-sided exact
    chance of at least so many fallen scores (binomial; unchanged scores have not fallen).
    """
    before: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    after: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    gsd_m = world.backgrounds.gsd_m
    with frozen(detectors):
        weights = attack_weights(camouflage, detectors, world, settings)
        for batch in range(settings.balance_batches):
            scenes = world.step_scenes(settings.batch_size, settings.seed, -batch)
            moved = copy.deepcopy(camouflage)
            moved.before_step_(1, settings.steps)
            _, shown = add_gradients(moved, detectors, weights, world, scenes, settings.method)
            descend(moved, make_optimiser(moved, settings))
            with torch.no_grad():
                stepped = world.frames(moved, scenes)
            for detector in detectors:
                before[detector.name] += [target_scores(detector, each, gsd_m) for each in shown]
                after[detector.name].append(target_scores(detector, stepped, gsd_m))
    for name, scores in (*before.items(), *after.items()):
        if not bool(torch.cat(scores).isfinite().all()):
            raise NotFiniteError(
                f"The scores of the detector {name} are not finite on the attack's scenes; train "
                "or import it again, or attack with a lower learning rate."
            )
    return {name: _compared(torch.cat(before[name]), torch.cat(after[name])) for name in before}


def _compared(before: Tensor, after: Tensor) -> dict[str, Any]:
    fell = int((after < before).sum())
    return {
        "scenes": len(before),
        "fell": fell,
        # The binomial tail as scipy.stats has it, whose import takes as long as some steps.
        "p": float(special.bdtrc(fell - 1, len(before), 0.5)),
        "mean_change": float((after - before).mean()),
    }


def _constraints(
    name: CamouflageName, palette: Tensor | None, settings: CamouflageSettings
) -> dict[str, Any]:
    """Returns what decides a control, apart from its name and seed, as JSON values."""
    return {
        "camouflage": asdict(settings),
        "palette": palette.tolist() if palette is not None and name.takes_palette else None,
    }


def _is_made(folder: Path, key: str, made_from: dict[str, Any]) -> bool:
    """Whether a control is stored; one that was made from something else is refused."""
    if not (folder / "camouflage.json").exists():
        return False
    stored = read_record(folder).get(key)
    refuse_other(folder, stored, made_from, "a control that was made otherwise")
    return True


def _store(folder: Path, camouflage: Camouflage, record: dict[str, Any]) -> None:
    drop_empty_folder(folder)
    with finished_folder(folder) as partial:
        save_camouflage(partial, camouflage, record)
