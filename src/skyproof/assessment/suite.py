"""The suites of attacks of `skyproof assess` and of the demo: frozen, so that results compare."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from skyproof.attacks.settings import AttackSettings, QuerySettings
from skyproof.camouflage.name import CamouflageName, chosen_controls
from skyproof.documents import read_document
from skyproof.ranges import Count, WholeNumber
from skyproof.seeds import next_seed

SUITE = Path(__file__).with_name("suite.json")
DEMO_SUITE = Path(__file__).with_name("demo.json")


@dataclass(frozen=True)
class AttackSteps:
    """Optimiser steps of an attack by its kind."""

    texture: Count
    shape: Count
    sequential: Count
    parallel: Count

    def of(self, name: CamouflageName) -> int:
        if name.kind == "combination":
            return self.sequential if name.order == "seq" else self.parallel
        return self.texture if name.kind == "texture" else self.shape


@dataclass(frozen=True)
class Expected:
    """The EASR of an attack when the suite was made, with its 95 % interval."""

    easr: float
    low: float
    high: float


@dataclass(frozen=True)
class Suite:
    """One version of a suite.

    Attributes:
        attacks: optimised camouflages; a texture stands before the shape on it.
        settings: settings of all attacks, except for the steps.
        searches: random searches for each attack's control on detectors with gradients; a
            black-box detector is searched once, with a budget of queries.
        compared: attacks that are repeated as query attacks on a single detector with gradients; a
            stronger query attack shows that the gradients mislead.
        attack_m: side of the images in attacks, in metres.
        image_m: side of the test images, in metres.
        test_images: number of test images, each with 1 to 5 vehicles.
        empty_images: test images without vehicles, at most as many as cover the test tiles. On 600
            of them, 100 false alarms per km² are 34, so chance moves the threshold little.
        tiles: number of drawn tiles per split (train, validation, attack, test), without imagery.
        check_scenes: number of test scenes of the precheck; with 0 the stored precheck of the
            detector folder is used.
        expected: EASR by reference detector and attack on drawn ground with seed 0.
    """

    version: Count
    attacks: tuple[str, ...]
    settings: AttackSettings
    steps: AttackSteps
    draws: Count
    best_of: Count
    searches: Count
    queries: QuerySettings
    compared: tuple[str, ...]
    attack_m: Annotated[float, Meta(gt=0)]
    image_m: Annotated[float, Meta(gt=0)]
    test_images: Count
    empty_images: Count
    tiles: tuple[Count, Count, Count, Count]
    vehicles: tuple[Count, Count, Count, Count]
    check_scenes: WholeNumber
    check_draws: Count
    expected: Mapping[str, Mapping[str, Expected]] = field(default_factory=dict)

    @property
    def names(self) -> list[CamouflageName]:
        return [CamouflageName.parse(text) for text in self.attacks]

    def attack(self, name: CamouflageName, seed: int) -> AttackSettings:
        return replace(self.settings, steps=self.steps.of(name), seed=seed)

    def chosen_controls(self, seed: int, searches: int) -> dict[CamouflageName, AttackSettings]:
        """The controls that the detectors choose, with the steps of the longest attack."""
        under = self.steps.texture
        steps = {name: self.steps.of(name) + under * (name.order == "seq") for name in self.names}
        return {
            control: replace(self.settings, steps=count, seed=next_seed(seed, control.number))
            for control, count in chosen_controls(steps, searches).items()
        }

    def random_controls(self) -> list[str]:
        names = dict.fromkeys(name.control for name in self.names)
        return [str(name.with_repeat(draw)) for name in names for draw in range(self.draws)]

    def random_shapes(self) -> dict[str, list[str]]:
        """The names of random shapes, by the optimised texture under them."""
        shapes: dict[str, list[str]] = {}
        for name in self.names:
            control = name.random_shape
            if control is not None:
                names = [str(control.with_repeat(draw)) for draw in range(self.draws)]
                shapes.setdefault(texture_under(name), []).extend(names)
        return shapes


def read_suite(path: Path = SUITE) -> Suite:
    """Reads a suite that comes with this version of skyproof."""
    return read_document(path, Suite, "install skyproof again")


def texture_under(name: CamouflageName) -> str:
    """The name of the texture under the shape of a sequential attack."""
    return str(CamouflageName("texture", name.constraints))
