"""What of an assessment knows a detector's answers alone: attacks carried over, then asked."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from skyproof.assessment.asking import Query
from skyproof.assessment.attack_job import AttackJob
from skyproof.assessment.plan import START_S, Step
from skyproof.assessment.steps import attack_step
from skyproof.assessment.suite import Suite
from skyproof.assessment.world import GSD_M
from skyproof.attacks.settings import QuerySettings
from skyproof.camouflage.name import ASKED, TRANSFER, CamouflageName
from skyproof.cli.reference import Reference
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS
from skyproof.errors import ConfigurationError
from skyproof.layout import Layout
from skyproof.scenes.places import Places

_ASK_S = 0.03


@dataclass(frozen=True)
class ByAnswers:
    """The steps of attacks by answers.

    They are learnt on the detectors that come with skyproof, and carried on from there by what the
    detector answers.

    Attributes:
        layout: the run folder's.
        suite: the attacks.
        name: the detector's.
        box: what answers, where its folder holds a card alone; else None.
        seed: of the run.
        places: where vehicles stand.
        gsd_m: metres per pixel of what it is shown.
        device: auto, cpu or cuda.
    """

    layout: Layout
    suite: Suite
    name: str
    box: Any
    seed: int
    places: Places
    gsd_m: float
    device: str

    @property
    def possible(self) -> bool:
        """Whether it sees what the teachers see."""
        return math.isclose(self.gsd_m, GSD_M)

    def teachers(self) -> list[Step]:
        """The detectors that teach.

        Raises:
            ConfigurationError: they see another resolution.
        """
        if not self.possible:
            raise ConfigurationError(
                f"A detector that only answers is attacked with what hides from skyproof's own "
                f"detectors, which see {GSD_M} m per pixel, got {self.gsd_m:g}; give it images of "
                f"{GSD_M} m and resize them in its detect."
            )
        own = self.layout.teachers
        return [
            Step(
                "teacher",
                name,
                Reference(own.detectors, (name,), check=False),
                (),
                (own.detector(name) / "detector.json",),
                effort_s=0.1,
            )
            for name in REFERENCE_DETECTORS
        ]

    def every(self) -> list[Step]:
        """All attacks of the suite on a black box; the texture under a shape is asked first."""
        steps = []
        for job in self.suite.learnt(REFERENCE_DETECTORS, self.seed, TRANSFER):
            name = CamouflageName.parse(job.name)
            steps += [self._learnt(job), self._asked(name.base, job.name)]
        return steps

    def compared(self) -> list[Step]:
        """Those that are also sought by answers on a detector that has gradients."""
        steps = []
        for job in self.suite.learnt(REFERENCE_DETECTORS, self.seed, TRANSFER):
            base = CamouflageName.parse(job.name).base
            if str(base) in self.suite.compared:
                steps += [self._learnt(job), self._asked(base.with_variant(ASKED), job.name)]
        return steps

    def searches(self, names: list[str]) -> list[Step]:
        """Random searches with as many answers."""
        return [self._asked(CamouflageName.parse(name), None) for name in names]

    def made(self, steps: list[Step]) -> Iterator[str]:
        """What steps of these leave to be scored, relative to `camouflages/`."""
        for step in steps:
            if isinstance(step.command, Query):
                yield from step.command.folders
            elif step.kind in ("attack", "choose"):
                yield step.name

    def _learnt(self, job: AttackJob) -> Step:
        return attack_step(
            self.layout,
            job,
            self.suite.attack_px(self.gsd_m),
            places=self.places,
            teachers=self.layout.teachers,
            device=self.device,
        )

    def _asked(self, name: CamouflageName, start: str | None) -> Step:
        layout = self.layout
        settings: QuerySettings = replace(self.suite.queries, seed=self.seed)
        command = Query(
            name=str(name),
            start=None if start is None else layout.camouflage(start),
            out=layout.camouflages,
            detector=layout.detector(self.name),
            box=self.box,
            backgrounds=layout.backgrounds,
            fleet=layout.fleets / "attack",
            image_px=self.suite.attack_px(self.gsd_m),
            places=self.places,
            settings=settings,
            device=self.device,
        )
        inputs = [layout.backgrounds, layout.fleets, layout.detector(self.name) / "detector.json"]
        if command.start is not None:
            inputs.append(command.start / "camouflage.json")
        return Step(
            "ask",
            str(name),
            command,
            tuple(inputs),
            (layout.camouflage(str(name)) / "camouflage.json",),
            growing=True,
            effort_s=START_S + _ASK_S * settings.images,
        )
