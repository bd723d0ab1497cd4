"""The steps of an assessment: from somebody's detector and imagery to a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from skyproof.assessment.asking import Asked, Frozen
from skyproof.assessment.black_box import ByAnswers
from skyproof.assessment.enough import Enough
from skyproof.assessment.plan import START_S, Plan, Step
from skyproof.assessment.steps import (
    attack_step,
    check_step,
    control_step,
    report_step,
    score_step,
)
from skyproof.assessment.suite import Suite
from skyproof.assessment.world import (
    WorldSizes,
    render_step,
    scene_step,
    vehicles_step,
    world_steps,
)
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.attack import Attack
from skyproof.cli.clear import Clear
from skyproof.cli.ground import Ground, tiling_for_images
from skyproof.cli.import_detector import Import
from skyproof.cli.precheck import Precheck
from skyproof.cli.rendering import Rendering
from skyproof.cli.score import Score
from skyproof.files import finished_folder
from skyproof.imagery.settings import LabelSettings, SourceSettings
from skyproof.layout import Layout
from skyproof.scenes.places import Places

_SCORED_AT_ONCE = 24
# Of train, validation, attack and test: as many tiles as the suite draws, roughly.
_SHARES = (0.0, 0.25, 0.25, 0.5)
_CLEAR_S = 0.5
_IMPORT_S = 60.0


@dataclass(frozen=True)
class Given:
    """What is assessed, on what; the options of `skyproof assess` as its plan needs them.

    Attributes:
        name: the detector's, in tables.
        detector: its folder, or its checkpoint file; None where only its answers are known.
        gsd_m: metres per pixel of what it is shown.
        imagery: images or folders of them; none for drawn ground.
        imagery_gsd_m: metres per pixel of images that do not say it themselves.
        labels: of the vehicles in the imagery.
        label_classes: of the labels, which are vehicles.
        vehicle_classes: of a checkpoint, which are vehicles.
        architecture: of a checkpoint of torchvision.
        requirement: accept, reject, producer_risk and consumer_risk, as for the report; empty where
            nothing is asked.
        seed: decides everything that is drawn.
        cycles: whether the test scenes are judged on Cycles, too.
        blender: which Blender draws them.
        device: auto, cpu or cuda.
    """

    name: str
    detector: Path | None
    gsd_m: float
    imagery: tuple[Path, ...]
    imagery_gsd_m: float | None
    labels: Path | None
    label_classes: tuple[str, ...]
    vehicle_classes: tuple[str, ...]
    architecture: str | None
    requirement: Mapping[str, float]
    seed: int
    cycles: bool = False
    blender: Path | None = None
    device: str = "auto"

    @property
    def places(self) -> Places:
        """Where vehicles stand: in photographs not on roofs and in trees."""
        return "drivable" if self.imagery else "uniform"


@dataclass(frozen=True)
class _Copy:
    """Copies a detector folder as it is, but for what a check elsewhere found of it."""

    detector: Path
    out: Path

    def run(self) -> None:
        """Copies it."""
        from skyproof.detectors.loaded import copy_detector, load_detector

        load_detector(self.detector)
        with finished_folder(self.out) as folder:
            copy_detector(self.detector, folder, ["steps.jsonl"])


def assessment_plan(given: Given, suite: Suite, folder: Path, box: Any = None) -> Plan:
    """Returns the steps from a detector and imagery to a report.

    Args:
        given: what is assessed.
        suite: the attacks.
        folder: the run folder, as the steps are to name it.
        box: the detector, where only its answers are known.
    """
    layout = Layout(folder)
    own = layout.detector(given.name)
    sizes = replace(suite.sizes(given.gsd_m), test_places=given.places)
    names = (given.name,)
    by_answers = ByAnswers(
        layout, suite, given.name, box, given.seed, given.places, given.gsd_m, given.device
    )
    steps = [*_ground_and_detector(given, suite, layout, sizes, box)]
    steps += [
        vehicles_step(layout, sizes, given.seed),
        scene_step(layout, sizes, "test", given.seed),
    ]
    if given.requirement:
        steps.append(_enough_step(layout, given.requirement))
    steps.append(render_step(layout, sizes, "test", device=given.device))
    frames = (f"your imagery={layout.tiles / 'test'}@{given.gsd_m}",) if given.labels else ()
    classes = ("vehicle",)
    steps.append(
        check_step(
            layout,
            sizes,
            names,
            suite.check_scenes,
            suite.check_draws,
            given.seed,
            frames=frames,
            frame_classes=classes,
            device=given.device,
        )
    )
    made = _made(given, suite, layout, by_answers)
    steps += made
    steps.append(control_step(layout, suite.drawn(), given.seed))
    shapes = suite.drawn_shapes()
    steps += [
        control_step(layout, drawn, given.seed, texture=texture)
        for texture, drawn in shapes.items()
    ]
    worn = [*by_answers.made(made)]
    every = [*worn, *suite.drawn(), *(name for drawn in shapes.values() for name in drawn)]
    scores = [
        score_step(
            layout,
            sizes,
            f"test-{first // _SCORED_AT_ONCE}",
            every[first : first + _SCORED_AT_ONCE],
            names,
            given.seed,
            frames=frames if first == 0 else (),
            frame_classes=classes,
            device=given.device,
        )
        for first in range(0, len(every), _SCORED_AT_ONCE)
    ]
    steps += scores
    if given.cycles:
        rendering = Rendering(renderer="cycles", blender=given.blender)
        steps.append(render_step(layout, sizes, "test", rendering=rendering, device=given.device))
        scores.append(
            score_step(
                layout,
                sizes,
                "test-cycles",
                [name for name in worn if "/" not in name],
                names,
                given.seed,
                rendering=rendering,
                device=given.device,
            )
        )
        steps.append(scores[-1])
    steps.append(report_step(layout, scores, names, requirement=given.requirement))
    return Plan(steps if box is None else [_asking(step, box, own) for step in steps])


def _enough_step(layout: Layout, requirement: Mapping[str, float]) -> Step:
    """Whether the test scenes show enough ground to decide what is asked."""
    scenes, enough = layout.scenes("test"), layout.folder / "enough.json"
    command = Enough(scenes, requirement["reject"], requirement["consumer_risk"], enough)
    # Another requirement may be asked of a run that has ended.
    return Step("size", "size", command, (scenes, layout.config), (enough,), renewed=True)


def _made(given: Given, suite: Suite, layout: Layout, by_answers: ByAnswers) -> list[Step]:
    """What is learnt, asked or chosen; whatever can be, on the detector itself."""
    attack_px = suite.attack_px(given.gsd_m)
    chosen = suite.chosen(given.name, given.seed)
    if given.detector is None:
        searched = [job.name for job in chosen if CamouflageName.parse(job.name).choice == "search"]
        steps = [*by_answers.teachers(), *by_answers.every(), *by_answers.searches(searched)]
        own = [job for job in chosen if job.name not in searched]
    else:
        steps = []
        own = [*suite.learnt((given.name,), given.seed), *chosen]
    steps += [
        attack_step(layout, job, attack_px, places=given.places, device=given.device) for job in own
    ]
    if given.detector is not None and by_answers.possible:
        steps += [*by_answers.teachers(), *by_answers.compared()]
    return steps


def _asking(step: Step, box: Any, folder: Path) -> Step:
    """The same step, where it needs a detector by asking the black box."""
    command = step.command
    if isinstance(command, Clear | Precheck | Score | Attack):
        return replace(step, command=Asked(command, box, folder))
    return step


def _ground_and_detector(
    given: Given, suite: Suite, layout: Layout, sizes: WorldSizes, box: Any
) -> list[Step]:
    """Ground without vehicles, and the detector with its threshold, whichever can come first."""
    detector = layout.detector(given.name)
    card = detector / "detector.json"
    if not given.imagery:
        drawn = world_steps(layout, sizes, given.seed, splits=(), device=given.device)[:1]
        return [*drawn, *_without_labels(given, suite, layout, box)]
    tiling = tiling_for_images(sizes.image_px, gsd_m=given.gsd_m, imagery=True)
    # Nothing is trained here: all the ground is to freeze, to learn attacks on, and to judge.
    tiling = replace(tiling, shares=_SHARES)
    cut = Ground(
        out=layout.tiles,
        sources=given.imagery,
        seed=given.seed,
        tiling=tiling,
        source=SourceSettings(gsd_m=given.imagery_gsd_m),
        labels=LabelSettings(path=given.labels, classes=given.label_classes),
    )
    inputs = (*given.imagery, *([given.labels] if given.labels else []))
    steps = [Step("ground", "tiles", cut, inputs, (layout.tiles,), effort_s=_IMPORT_S)]
    if given.labels is None:
        steps += _without_labels(given, suite, layout, box)
    elif given.detector is not None and given.detector.is_dir():
        needed = (given.detector, layout.tiles)
        frozen = Precheck(
            detectors=(given.detector,),
            freeze="labels",
            frames=(f"your imagery={layout.tiles / 'validation'}@{given.gsd_m}",),
            frame_classes=("vehicle",),
            out=detector,
            device=given.device,
        )
        steps.append(Step("threshold", given.name, frozen, needed, (card,), effort_s=_IMPORT_S))
    else:
        validation = layout.tiles / "validation"
        steps.append(_brought_step(given, validation, layout.tiles, detector, box))
    clear = Clear(
        folder=layout.tiles, out=layout.backgrounds, detector=detector, device=given.device
    )
    steps.append(
        Step(
            "clear", "clear", clear, (layout.tiles, card), (layout.backgrounds,), effort_s=_IMPORT_S
        )
    )
    return steps


def _without_labels(given: Given, suite: Suite, layout: Layout, box: Any) -> list[Step]:
    """The detector as it is; a threshold that is not there is frozen on rendered vehicles."""
    out = layout.detector(given.name)
    if given.detector is not None and given.detector.is_dir():
        copied = _Copy(given.detector, out)
        outputs = (out / "detector.json",)
        return [Step("detector", given.name, copied, (given.detector,), outputs)]
    world = Layout(layout.folder / "threshold")
    sizes = replace(suite.sizes(given.gsd_m), tiles=(1, suite.tiles[1], 1, 1))
    steps = world_steps(world, sizes, given.seed, splits=("validation",), device=given.device)
    validation = world.dataset("validation")
    brought = _brought_step(given, validation, validation, out, box)
    # The run has ground and vehicles of its own under the usual names.
    return [*(replace(step, name=f"threshold-{step.name}") for step in steps), brought]


def _brought_step(given: Given, validation: Path, needed: Path, out: Path, box: Any) -> Step:
    """A checkpoint or a black box, with a threshold frozen on these images."""
    outputs = (out / "detector.json",)
    if given.detector is None:
        frozen = Frozen(box, validation, out)
        return Step("threshold", given.name, frozen, (needed,), outputs, effort_s=_IMPORT_S)
    command = Import(
        checkpoint=given.detector,
        kind="torchvision" if given.architecture else "ultralytics",
        vehicle_classes=given.vehicle_classes,
        validation=validation,
        out=out,
        architecture=given.architecture,
        name=given.name,
        device=given.device,
    )
    inputs = (given.detector, needed)
    return Step("import", given.name, command, inputs, outputs, effort_s=START_S + _IMPORT_S)
