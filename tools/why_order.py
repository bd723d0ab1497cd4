"""Experiments on why some attacks stand elsewhere in our order than in the paper's.

It makes docs/results/order.csv.

    python tools/why_order.py --run-folder runs/demo --out runs/order \\
        --palettes town=town.json forest=forest.json

Every attack is learnt as in the quick preset, but for what its variant changes, and judged on 64
scenes of the attack's own ground and vehicles that no step sees. What the table has is not made
again.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
import tyro
from torch import Tensor

from skyproof.attacks.attack import attack
from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette, load_palette
from skyproof.camouflage.texture import UniversalTexture
from skyproof.detectors.loaded import load_ensemble
from skyproof.files import write_bytes
from skyproof.layout import Layout
from skyproof.randomness import generator_of

SIZE_PX = 128
TEXTURES = ("T-Fc", "T-FcMa")
SHAPE = "S-O@0.4"


class PapersColours(UniversalTexture):
    """Colours as in section S4.2: probabilities p, shown as s(s(p)), and a softmax after steps.

    s raises to the power 1/temperature and divides by the sum; the paper does not give the
    temperature.
    """

    softness = 0.5

    def start_(self) -> PapersColours:
        """Makes probabilities of the drawn logits, which are logarithms."""
        with torch.no_grad():
            self.cells.copy_(torch.softmax(self.cells, dim=0))
        self.learning_rates = {}
        return self

    def _coloured(self) -> Tensor:
        if self.finished:
            return super()._coloured()
        logits = self.cells.clamp(min=1e-6).log() / self.softness**2
        return torch.einsum("kc,kij->cij", self.palette, torch.softmax(logits, dim=0))

    @torch.no_grad()
    def project_(self) -> None:
        """Makes the probabilities sum to 1 again, as the paper does: by a softmax."""
        self.cells.copy_(torch.softmax(self.cells, dim=0))


class PapersSharpColours(PapersColours):
    """The same with a temperature that leaves nearly one colour a texel."""

    softness = 0.1


@dataclass(frozen=True)
class WhyOrder:
    """Learns the variants and says what each hides.

    Attributes:
        run_folder: a finished demo or reproduction: its ground, vehicles for attacks and detectors.
        out: folder for the attacks, and the table, `order.csv`.
        palettes: colours of other ground, `NAME=FILE`, as `skyproof attack --palette` takes them.
        seeds: of every attack.
        detectors: which of the run's are attacked.
        settings: of every attack, but for its steps where a variant has others.
    """

    run_folder: Path
    out: Path
    palettes: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0, 1)
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn")
    settings: AttackSettings = field(
        default_factory=lambda: AttackSettings(steps=200, preview_every=1000)
    )

    def run(self) -> None:
        """Learns what the table lacks, and writes it after every attack."""
        torch.set_num_threads(1)
        layout = Layout(self.run_folder)
        world = AttackWorld.open(layout.backgrounds, layout.fleets / "attack", size_px=SIZE_PX)
        judges = load_ensemble(
            [layout.detector(name) for name in self.detectors],
            torch.device("cpu"),
            world.backgrounds.gsd_m,
        )
        palette = ground_palette(world.backgrounds)
        rows = self._known()
        for name, variant, steps, make in self._variants(palette):
            for seed in self.seeds:
                if any(row[:4] == [name, variant, str(steps), str(seed)] for row in rows):
                    continue
                settings = AttackSettings(**{**vars(self.settings), "steps": steps, "seed": seed})
                camouflage = attack(
                    make(generator_of(seed, "why order", name)),
                    [judge.detector for judge in judges],
                    world,
                    settings,
                    self.out / f"{name} {variant} {seed}".replace(" ", "_"),
                )
                hidden = HeldOut(judges, world, seed).judge(camouflage).hidden
                rows.append([name, variant, str(steps), str(seed), f"{100 * hidden:.1f}"])
                print(*rows[-1], flush=True)
                self._write(rows)

    def _variants(
        self, palette: Tensor
    ) -> list[tuple[str, str, int, Callable[[torch.Generator], Camouflage]]]:
        """Lists name, variant, steps, and what makes the camouflage."""

        def texture(name: str, colours: Tensor) -> Callable[[torch.Generator], Camouflage]:
            return lambda generator: make_camouflage(name, generator=generator, palette=colours)

        def papers(kind: type[PapersColours], name: str) -> Callable[[torch.Generator], Camouflage]:
            parsed = CamouflageName.parse(name)
            return lambda generator: kind(parsed, generator=generator, palette=palette).start_()

        def shape(*, frozen_parts: bool) -> Callable[[torch.Generator], Camouflage]:
            name = CamouflageName.parse(SHAPE)
            return lambda _: DisplacementMap(name, frozen_parts=frozen_parts)

        steps = self.settings.steps
        variants = []
        for name in TEXTURES:
            variants += [
                (name, "as it is", steps, texture(name, palette)),
                (name, "colours by s(s(p))", steps, papers(PapersColours, name)),
                (name, "sharper s(s(p))", steps, papers(PapersSharpColours, name)),
            ]
            for given in self.palettes:
                label, _, file = given.partition("=")
                colours = load_palette(Path(file))
                variants.append((name, f"colours of {label}", steps, texture(name, colours)))
        variants += [
            (SHAPE, "as it is", steps, shape(frozen_parts=True)),
            (SHAPE, "wheels and underside move", steps, shape(frozen_parts=False)),
            (SHAPE, "three times the steps", 3 * steps, shape(frozen_parts=True)),
        ]
        return variants

    def _known(self) -> list[list[str]]:
        place = self.out / "order.csv"
        if not place.exists():
            return []
        return list(csv.reader(place.read_text(encoding="utf-8").splitlines()))[1:]

    def _write(self, rows: list[list[str]]) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["attack", "variant", "steps", "seed", "hidden"])
        writer.writerows(rows)
        write_bytes(self.out / "order.csv", text.getvalue().encode())


if __name__ == "__main__":
    tyro.cli(WhyOrder).run()
