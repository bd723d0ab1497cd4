"""Experiments on free textures that end in poor optima: other starts, steps, masks, objectives.

    python tools/poor_optima.py --run-folder runs/trainings --name T-Ma-0 --out optima/as_it_is
    python tools/poor_optima.py --run-folder runs/trainings --name T-Ma-0 --out optima/blocks \\
        --start-block-texels 64

Learns one camouflage before a run's detectors as the presets do, but for what is changed, and
prints how many vehicles of 64 scenes of the attack's own ground it hides, the same for every start
and seen by no step. `--judge` judges finished camouflages on them instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal
from unittest import mock

import torch
import tyro
from torch import Tensor

from skyproof.attacks import objective
from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.loaded import load_ensemble
from skyproof.layout import Layout
from skyproof.randomness import generator_of
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch

SIZE_PX = 96
JUDGING_SEED = 99


class MaskedLater(UniversalTexture):
    """A texture that lies on whole vehicles for a share of the steps, and then under its mask."""

    everywhere = False
    share: ClassVar[float] = 0.0

    def before_step_(self, step: int, steps: int) -> None:
        """Says where the map is laid in this step."""
        super().before_step_(step, steps)
        self.everywhere = (step - 1) / steps < self.share

    def mask(self, vehicles: VehicleBatch) -> Tensor | None:
        """Says where the map is laid."""
        return None if self.everywhere else super().mask(vehicles)


@dataclass(frozen=True)
class Experiment:
    """What is learnt, or judged.

    Attributes:
        run_folder: its ground, vehicles and detectors are attacked.
        training: which training of the detectors.
        detectors: names of those that are attacked together.
        name: of the camouflage; its repeat is the seed.
        out: folder of the attack.
        judge: folders of finished camouflages that are judged, where nothing is to be learnt.
        steps: of four images.
        learning_rate: Adam's.
        start_block_texels: side of the blocks of full colours that a free texture begins with, in
            place of even noise.
        masked_from: share of the steps after which the mask holds.
        logarithm_of: what the objective takes the logarithm of: every image's loss, as the presets
            do, the mean over a detector's images, or nothing.
        floor: is added to what the logarithm is taken of.
    """

    run_folder: Path
    training: int = 0
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    name: str = "T-Ma-0"
    out: Path = Path("optima")
    judge: tuple[Path, ...] = ()
    steps: int = 300
    learning_rate: float = 0.05
    start_block_texels: int = 0
    masked_from: float = 0.0
    logarithm_of: Literal["images", "means", "nothing"] = "images"
    floor: float = objective._FOOLED


def main(experiment: Experiment) -> None:
    """Learns and judges."""
    torch.set_num_threads(1)
    layout = Layout(experiment.run_folder)
    world = AttackWorld.open(
        layout.backgrounds,
        layout.fleets / "attack",
        size_px=SIZE_PX,
        conditions=("clear",),
        places="uniform",
    )
    teachers = layout.training(experiment.training) if experiment.training else layout
    folders = [teachers.detector(name) for name in experiment.detectors]
    ensemble = load_ensemble(folders, "cpu", world.backgrounds.gsd_m)
    judges = HeldOut(ensemble, world, JUDGING_SEED)
    if experiment.judge:
        for folder in experiment.judge:
            print(f"{folder}: {100 * judges.judge(load_camouflage(folder)).hidden:.1f} %")
        return
    name = CamouflageName.parse(experiment.name)
    seed = int(name.repeat or 0)
    camouflage = _start(name, seed, experiment, world)
    settings = AttackSettings(
        steps=experiment.steps,
        learning_rate=experiment.learning_rate,
        preview_every=experiment.steps,
        seed=seed,
    )
    if name.choice == "search":
        settings = settings.of_search()

    def term(weight: float, losses: Tensor) -> Tensor:
        if experiment.logarithm_of == "images":
            return (weight * losses + experiment.floor).log().mean()
        mean = weight * losses.mean()
        return mean if experiment.logarithm_of == "nothing" else (mean + experiment.floor).log()

    with mock.patch.object(objective, "_term", term):
        models = [each.detector for each in ensemble]
        attack(camouflage, models, world, settings, experiment.out)
    print(f"{experiment}: {100 * judges.judge(camouflage).hidden:.1f} %")


def _start(
    name: CamouflageName, seed: int, experiment: Experiment, world: AttackWorld
) -> Camouflage:
    palette = ground_palette(world.backgrounds) if name.takes_palette else None
    generator = generator_of(seed, "texture", str(name))
    if experiment.masked_from:
        MaskedLater.share = experiment.masked_from
        return MaskedLater(name, generator=generator, palette=palette)
    camouflage = make_camouflage(name, generator=generator, palette=palette)
    if experiment.start_block_texels:
        assert isinstance(camouflage, UniversalTexture)
        blocks = TEXTURE_SIZE // experiment.start_block_texels
        drawn = torch.rand(3, blocks, blocks, generator=generator_of(seed, "coarse")).round()
        side = camouflage.cells.shape[-1] // blocks
        with torch.no_grad():
            camouflage.cells.copy_(
                drawn.repeat_interleave(side, dim=1).repeat_interleave(side, dim=2)
            )
    return camouflage


if __name__ == "__main__":
    main(tyro.cli(Experiment))
