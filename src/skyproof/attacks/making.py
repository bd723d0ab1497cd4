"""Makes camouflages by name, each in a folder of its own: drawn, chosen, or optimised.

Finished ones are kept, unless they were made with other detectors, scenes or colours.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.attacks import held_out
from skyproof.attacks.attack import attack
from skyproof.attacks.search import choose
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.sign_test import sign_test
from skyproof.attacks.world import World
from skyproof.camouflage import make
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import read_record, save_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.console import progress_bar
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.files import drop_empty_folder, finished_folder
from skyproof.loop import refuse_other
from skyproof.randomness import generator_of
from skyproof.storage import weights_digest


def draw_random_control(
    name: CamouflageName,
    folder: Path,
    *,
    seed: int,
    palette: Float[Tensor, "colours 3"] | None = None,
    texture: Camouflage | None = None,
    settings: CamouflageSettings | None = None,
) -> None:
    """Draws a random control, such as "R-PixFc-3", into a folder of its own (section 5.4).

    Arguments are those of `make_camouflage`.
    """
    settings = settings or CamouflageSettings()
    drawn = {
        "seed": seed,
        **_constraints(name, palette, settings),
        "texture_sha256": None if texture is None else weights_digest(texture),
    }

    def draw() -> tuple[Camouflage, dict[str, Any]]:
        control = make.draw_control(
            name, seed=seed, palette=palette, texture=texture, settings=settings
        )
        return control, {"seed": seed, "drawn": drawn}

    _make_once(folder, "drawn", drawn, draw)


@dataclass(frozen=True)
class Maker:
    """Makes camouflages against detectors, in one world.

    Attributes:
        detectors: attacked together, on `device`.
        device: where camouflages are drawn and optimised.
        palette: colours of Fc, and those from which Lc and Pix start.
        camouflage: numbers that the names leave open.
    """

    detectors: Sequence[Detector]
    world: World
    settings: AttackSettings
    device: torch.device
    palette: Float[Tensor, "colours 3"] | None = None
    camouflage: CamouflageSettings = field(default_factory=CamouflageSettings)

    def make(
        self, name: CamouflageName, folder: Path, *, draws: int, texture: Camouflage | None
    ) -> None:
        """Chooses a plain-paint or best-of-N control, and optimises every other camouflage.

        `draws` is the number of random draws of a best-of-N control, `texture` the finished one
        under the shape of a sequential combination. A progress bar is shown.
        """
        if name.has_candidates:
            with progress_bar(f"choose {name}") as update:
                self._choose(name, folder, draws, update)
        else:
            with progress_bar(f"attack {name}") as update:
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
            "draws": draws if name.choice == "best" else None,
            **_constraints(name, self.palette, self.camouflage),
            "texture_sha256": None,
        }

        def best() -> tuple[Camouflage, dict[str, Any]]:
            candidates = make.make_candidates(
                name, draws, seed=seed, palette=self.palette, settings=self.camouflage
            )
            moved = [candidate.to(self.device) for candidate in candidates]
            chosen, record = choose(moved, scenes, progress=progress)
            chosen.name = name
            return chosen, {"chosen": {**record, "seed": seed}, "by": by}

        _make_once(folder, "by", by, best)

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
            palette=self.palette,
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


def _constraints(
    name: CamouflageName, palette: Tensor | None, settings: CamouflageSettings
) -> dict[str, Any]:
    """What decides a control beside its name and seed, as JSON values."""
    return {
        "camouflage": asdict(settings),
        "palette": palette.tolist() if palette is not None and name.takes_palette else None,
    }


def _make_once(
    folder: Path,
    key: str,
    made_from: dict[str, Any],
    work: Callable[[], tuple[Camouflage, dict[str, Any]]],
) -> None:
    """Makes and stores a control, or refuses a stored one that was made from something else."""
    if (folder / "camouflage.json").exists():
        stored = read_record(folder).get(key)
        refuse_other(folder, stored, made_from, "a control that was made otherwise")
        return
    camouflage, record = work()
    drop_empty_folder(folder)
    with finished_folder(folder) as partial:
        save_camouflage(partial, camouflage, record)
