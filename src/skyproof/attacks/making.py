"""Camouflages by name, each made into a folder of its own: drawn, chosen, or optimised.

What is finished already is kept, unless it was made of other detectors, scenes or colours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks import held_out as held_out_scenes
from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.search import choose
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.sign_test import sign_test
from skyproof.attacks.world import World
from skyproof.camouflage import make
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import read_record, save_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.weights import weights_digest
from skyproof.files import drop_empty_folder, finished_folder
from skyproof.loop import refuse_other
from skyproof.randomness import generator_of

Progress = Callable[[int, int], None]


def draw_random_control(
    name: CamouflageName,
    folder: Path,
    *,
    seed: int,
    palette: Float[Tensor, "colours 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> None:
    """Draws a random control (section 5.4).

    Args:
        name: of the control, with its draw.
        folder: for it alone.
        seed: of the draw.
        palette: fixed colours, where the name takes some.
        texture: finished camouflage on whose texture a random shape is put.
        settings: what the name leaves open.

    Raises:
        RunFolderError: the folder holds a control that was drawn otherwise.
    """
    settings = settings or CamouflageSettings()
    drawn = {
        "seed": seed,
        **_decisive(name, palette, settings),
        "texture_sha256": None if texture is None else weights_digest(texture),
    }
    if (folder / "camouflage.json").exists():
        _refuse_other(folder, "drawn", drawn)
        return
    control = make.draw_control(
        name, seed=seed, palette=palette, texture=texture, settings=settings
    )
    _store(folder, control, {"seed": seed, "drawn": drawn})


@dataclass(frozen=True)
class Maker:
    """Makes camouflages against detectors, in one world.

    Attributes:
        detectors: attacked together, on the device to work on.
        world: what the attack sees.
        settings: steps, batch, learning rate, seed.
        device: where camouflages are drawn and optimised.
        palette: the colours of Fc, and those from which Lc and Pix take theirs.
        camouflage: what names leave open.
    """

    detectors: Sequence[LoadedDetector[Any]]
    world: World
    settings: AttackSettings
    device: torch.device
    palette: Float[Tensor, "colours 3"] | None = None
    camouflage: CamouflageSettings = field(default_factory=CamouflageSettings)

    def choose(
        self,
        name: CamouflageName,
        folder: Path,
        *,
        draws: int,
        progress: Progress | None = None,
    ) -> None:
        """Chooses a plain-paint or best-of-N control on held-out scenes of the attack.

        Args:
            name: of the control.
            folder: for it alone.
            draws: of how many random draws the best is taken.
            progress: called with (candidates tried, candidates in all).

        Raises:
            RunFolderError: the folder holds a control that was chosen otherwise.
        """
        held_out = self.held_out
        by = {
            "detectors": held_out.identity,
            "scenes": asdict(self.world.scenes),
            "world_sha256": self.world.digest,
            "seed": self.settings.seed,
            "draws": draws if name.choice == "best" else None,
            **_decisive(name, self.palette, self.camouflage),
            "texture_sha256": None,
        }
        if (folder / "camouflage.json").exists():
            _refuse_other(folder, "by", by)
            return
        candidates = [
            candidate.to(self.device)
            for candidate in make.make_candidates(
                name,
                draws,
                seed=self.settings.seed,
                palette=self.palette,
                settings=self.camouflage,
            )
        ]

        def tried(number: int) -> None:
            if progress:
                progress(number, len(candidates))

        chosen = choose(candidates, held_out, on_candidate=tried)
        record = {
            "chosen": {
                "of": [str(candidate.name) for candidate in candidates],
                "hidden": chosen.hidden,
                "scenes": chosen.scenes,
                "finalists": {
                    str(candidates[number].name): hidden
                    for number, hidden in chosen.finalists.items()
                },
                "final_scenes": chosen.final_scenes,
                "seed": self.settings.seed,
            },
            "by": by,
        }
        chosen.camouflage.name = name
        _store(folder, chosen.camouflage, record)

    def optimise(
        self,
        name: CamouflageName,
        folder: Path,
        *,
        texture: Camouflage | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Attacks the detectors after a sign test of the gradient, or searches without one.

        A stopped attack goes on where it was.

        Args:
            name: of the camouflage, or of a search control.
            folder: for it alone.
            texture: finished texture that a sequential combination puts its shape on.
            progress: called with (steps done, steps in all).
        """
        camouflage = make.make_camouflage(
            name,
            generator=generator_of(self.settings.seed, "texture", str(name)),
            palette=self.palette,
            texture=texture,
            settings=self.camouflage,
        ).to(self.device)
        models = [each.detector for each in self.detectors]
        settings = self.settings.of_search() if name.random else self.settings

        def signs() -> dict[str, Any]:
            if name.random:
                return {}
            return {"sign_test": sign_test(camouflage, models, self.world, settings)}

        def show(row: dict[str, Any]) -> None:
            if progress:
                progress(row["step"], settings.steps)

        attack(
            camouflage,
            models,
            self.world,
            settings,
            folder,
            held_out=self.held_out,
            record=signs,
            on_step=show,
        )

    @property
    def held_out(self) -> HeldOut:
        """Scenes of the same world that no step of an attack sees."""
        batch_size = max(held_out_scenes.BATCH_SIZE, self.settings.batch_size)
        return HeldOut(self.detectors, self.world, self.settings.seed, batch_size)


def _decisive(
    name: CamouflageName, palette: Tensor | None, settings: CamouflageSettings
) -> dict[str, Any]:
    """Gives what decides a control beside its name and seed, as JSON values."""
    return {
        "camouflage": asdict(settings),
        "palette": palette.tolist() if palette is not None and name.takes_palette else None,
    }


def _refuse_other(folder: Path, key: str, wanted: dict[str, Any]) -> None:
    """Keeps a control of other detectors, scenes or colours from passing for this one."""
    stored = read_record(folder).get(key)
    # Controls of before do not say it.
    if stored is not None:
        refuse_other(folder, stored, wanted, "a control that was made otherwise")


def _store(folder: Path, camouflage: Camouflage, record: dict[str, Any]) -> None:
    """Writes a camouflage's folder, whole or not at all."""
    drop_empty_folder(folder)
    with finished_folder(folder) as partial:
        save_camouflage(partial, camouflage, record)
