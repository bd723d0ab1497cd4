"""The suite of attacks that `skyproof assess` puts a detector to, frozen under a version.

No option changes it: a verdict that names the version says how strong the attacks were.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from skyproof.assessment.attack_job import AttackJob
from skyproof.assessment.world import WorldSizes
from skyproof.attacks.settings import AttackSettings, QuerySettings
from skyproof.camouflage.name import CamouflageName
from skyproof.documents import read_document
from skyproof.files import file_digest
from skyproof.ranges import Count

SUITE = Path(__file__).with_name("suite.json")

_STRIDE_PX = 32
"""Sides of images are multiples of it, as detectors take them."""

_SMALLEST_PX = 96


@dataclass(frozen=True)
class AttackSteps:
    """Optimiser steps of an attack by its kind."""

    texture: Count
    shape: Count
    sequential: Count
    parallel: Count


@dataclass(frozen=True)
class Expected:
    """What an attack reached when the suite was made.

    Attributes:
        easr: share hidden.
        low, high: its 95 % interval.
    """

    easr: float
    low: float
    high: float


@dataclass(frozen=True)
class Suite:
    """One version of the suite.

    Attributes:
        version: its number; another suite has another.
        attacks: what is learnt on the detector; a texture stands before the shape on it.
        settings: how everything is learnt, but for the steps.
        steps: by kind of attack.
        draws: of every random control.
        best_of: of how many random draws the best is taken as a control.
        queries: how attacks are carried by answers alone to a detector that has no gradient.
        compared: attacks that are also sought so on a detector that has gradients: where answers
            alone hide more, its gradients mislead.
        attack_m: side of the images in attacks, in metres.
        image_m: side of the test images, in metres.
        test_images: how many, each with 1 to 5 vehicles.
        tiles: drawn per split (train, validation, attack, test), where there is no imagery.
        vehicles: in the fleet of each split.
        check_scenes: test scenes on which the detector is checked before the attacks.
        check_draws: of every random control in that check.
        expected: by detector that comes with skyproof and by attack, what was reached on drawn
            ground with seed 0.
    """

    version: Count
    attacks: tuple[str, ...]
    settings: AttackSettings
    steps: AttackSteps
    draws: Count
    best_of: Count
    queries: QuerySettings
    compared: tuple[str, ...]
    attack_m: Annotated[float, Meta(gt=0)]
    image_m: Annotated[float, Meta(gt=0)]
    test_images: Count
    tiles: tuple[Count, Count, Count, Count]
    vehicles: tuple[Count, Count, Count, Count]
    check_scenes: Count
    check_draws: Count
    expected: Mapping[str, Mapping[str, Expected]] = field(default_factory=dict)

    def sizes(self, gsd_m: float) -> WorldSizes:
        """Returns the sizes of a world that is seen at a resolution."""
        return WorldSizes(
            gsd_m=gsd_m,
            image_px=_side_px(self.image_m, gsd_m),
            tiles=self.tiles,
            vehicles=self.vehicles,
            training_images=1,
            validation_images=self.test_images,
            test_images=self.test_images,
        )

    def attack_px(self, gsd_m: float) -> int:
        """Returns the side of the images in attacks, at a resolution."""
        return _side_px(self.attack_m, gsd_m)

    def learnt(self, detectors: Sequence[str], seed: int, variant: str = "") -> list[AttackJob]:
        """Returns the attacks on some detectors together.

        Args:
            detectors: their names.
            seed: of the run.
            variant: what the attacks' names end in.
        """
        return [
            AttackJob(
                str(name.with_variant(variant) if variant else name),
                replace(self.settings, steps=self._steps(name), seed=seed),
                tuple(detectors),
                texture=texture_under(name) if name.order == "seq" else None,
            )
            for text in self.attacks
            for name in (CamouflageName.parse(text),)
        ]

    def chosen(self, detector: str, seed: int) -> list[AttackJob]:
        """Returns the controls that the detector chooses, with the steps of the longest attack."""
        steps: dict[CamouflageName, int] = {}
        for job in self.learnt((detector,), seed):
            own = job.settings.steps + (self.steps.texture if job.texture else 0)
            for control in CamouflageName.parse(job.name).unlearnt:
                steps[control] = max(own, steps.get(control, 0))
        return [
            AttackJob(
                str(control),
                replace(self.settings, steps=count, seed=seed),
                (detector,),
                best_of=self.best_of,
            )
            for control, count in steps.items()
        ]

    def drawn(self) -> list[str]:
        """Returns the names of the random controls."""
        controls = dict.fromkeys(CamouflageName.parse(text).control for text in self.attacks)
        return [
            str(control.with_repeat(draw)) for control in controls for draw in range(self.draws)
        ]

    def drawn_shapes(self) -> dict[str, list[str]]:
        """Returns the names of random shapes, by the learnt texture that they are put on."""
        shapes: dict[str, list[str]] = {}
        for text in self.attacks:
            name = CamouflageName.parse(text)
            if name.drawn_shape is not None:
                control = name.drawn_shape
                names = [str(control.with_repeat(draw)) for draw in range(self.draws)]
                shapes.setdefault(texture_under(name), []).extend(names)
        return shapes

    def _steps(self, name: CamouflageName) -> int:
        if name.kind == "combination":
            return self.steps.sequential if name.order == "seq" else self.steps.parallel
        return self.steps.texture if name.kind == "texture" else self.steps.shape


def read_suite() -> Suite:
    """Reads the suite that comes with this version of skyproof."""
    suite: Suite = read_document(SUITE, Suite, "install skyproof again")
    return suite


def suite_digest() -> str:
    """Returns the SHA-256 of the suite's file."""
    return file_digest(SUITE)


def texture_under(name: CamouflageName) -> str:
    """Returns the name of the texture that a sequential attack puts its shape on."""
    return str(CamouflageName("texture", name.constraints))


def _side_px(side_m: float, gsd_m: float) -> int:
    return max(_SMALLEST_PX, math.ceil(side_m / gsd_m / _STRIDE_PX) * _STRIDE_PX)
