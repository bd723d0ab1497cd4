"""Measures how the colour rule of the paper gains and loses success over the steps of an attack.

    skyproof assess retinanet --out runs/retinanet
    python tools/forgetting.py runs/retinanet docs/results/forgetting.csv

Both reference detectors are attacked together on the run's attack ground, at 128 px and with four
images a step. A row is the ASR of one detector at its frozen threshold, on 128 scenes of that
ground which no step sees. One core takes about two minutes per 400 steps; a second call goes on.
"""

from __future__ import annotations

import csv
import itertools
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
import tyro

from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import BATCHES, HeldOut
from skyproof.attacks.settings import AttackSettings, Method
from skyproof.attacks.world import World
from skyproof.camouflage import texture
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette
from skyproof.detectors.card import REFERENCE_DETECTORS, reference_folder
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import load_detector
from skyproof.layout import Layout
from skyproof.randomness import generator_of

TEXTURES = ("T-Fc", "T-PixFc", "T-FcMa", "T-PixFcMa")
STEPS = (1, 10, 50, 100, 200, 400, 800, 1600)
COLUMNS = ("attack", "method", "tau", "seed", "steps", "step", "detector", "asr")


class Trial(NamedTuple):
    """One attack; the paper gives no τ."""

    attack: str
    method: Method
    tau: float
    seed: int
    steps: int


def trials() -> Iterator[Trial]:
    """The paper's method with four seeds, then ours, longer attacks, and other τ."""
    for seed, name in itertools.product(range(4), TEXTURES):
        yield Trial(name, "paper", 0.5, seed, 400)
    for seed, name in itertools.product(range(2), TEXTURES):
        yield Trial(name, "skyproof", 0.5, seed, 400)
    for seed, name in itertools.product(range(2), TEXTURES):
        yield Trial(name, "paper", 0.5, seed, 1600)
    for seed, tau, name in itertools.product(range(2), (0.3, 1.0), TEXTURES):
        yield Trial(name, "paper", tau, seed, 400)


class Judge:
    """Scenes that no step sees, on which one detector finds vehicles."""

    def __init__(self, detector: TrainableDetector, world: World) -> None:
        self.detector = detector
        self._scenes = HeldOut([detector], world, 991, 16)
        self._found = self._finds(None)

    def asr(self, camouflage: Camouflage) -> float:
        """The share of the vehicles found without camouflage that it hides."""
        return float((self._found & ~self._finds(camouflage)).sum() / self._found.sum())

    def _finds(self, camouflage: Camouflage | None) -> torch.Tensor:
        scores = self._scenes._scores(camouflage, BATCHES)
        return scores[self.detector.name] >= self.detector.threshold


def measured(trial: Trial, judges: Sequence[Judge], world: World) -> Iterator[list[object]]:
    """Attacks, and yields a row for every kept copy and detector."""
    texture._PAPER_TAU = trial.tau
    kept = tuple(step for step in STEPS if step < trial.steps)
    settings = AttackSettings(
        method=trial.method,
        steps=trial.steps,
        seed=trial.seed,
        keep_at=kept,
        preview_every=10_000,
        checkpoint_every=10_000,
    )
    name = CamouflageName.parse(trial.attack)
    palette = ground_palette(world.backgrounds) if settings.takes_palette(name) else None
    generator = generator_of(trial.seed, "texture", trial.attack)
    camouflage = make_camouflage(name, generator=generator, palette=palette)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / trial.attack
        attack(camouflage, [judge.detector for judge in judges], world, settings, place)
        for step in (*kept, trial.steps):
            copy = place / "snapshots" / str(name.with_variant(f"step{step}"))
            worn = camouflage if step == trial.steps else load_camouflage(copy)
            for judge in judges:
                yield [*trial, step, judge.detector.name, f"{100 * judge.asr(worn):.1f}"]


def main(run: Path, out: Path) -> None:
    """Runs the trials that the table lacks."""
    torch.set_num_threads(1)
    layout = Layout(run)
    world = World.open(layout.backgrounds, layout.fleets / "attack", size_px=128)
    detectors = [load_detector(reference_folder(name)) for name in REFERENCE_DETECTORS]
    judges = [Judge(detector, world) for detector in detectors]
    done = set()
    if out.exists():
        with out.open(newline="", encoding="utf-8") as file:
            done = {tuple(row[:5]) for row in list(csv.reader(file))[1:]}
    with out.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if not done:
            writer.writerow(COLUMNS)
        for trial in trials():
            if tuple(map(str, trial)) not in done:
                writer.writerows([*measured(trial, judges, world)])
                file.flush()


if __name__ == "__main__":
    tyro.cli(main)
