"""`skyproof demo`: from nothing to a first robustness report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.assessment.answers import say_answers
from skyproof.assessment.attack_job import AttackJob
from skyproof.assessment.plan import Plan, Step
from skyproof.assessment.steps import (
    attack_step,
    check_step,
    control_step,
    reference_step,
    report_step,
    score_step,
    train_step,
)
from skyproof.assessment.world import GSD_M, RENDERED, WorldSizes, render_step, world_steps
from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.console import say
from skyproof.cli.rendering import Rendering
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, reference_folder
from skyproof.detectors.settings import TrainingSettings
from skyproof.documents import check_document
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.layout import Layout
from skyproof.ranges import Count, GroundResolution, Seed, WholeNumber
from skyproof.scenes.sensor import BlurChoice
from skyproof.seeds import next_seed

TEXTURES = ("T-U", "T-PixFcMa")
"""What the demo learns: without any constraint, and in blocks of ground colours on paint alone."""

TRAINED = ("retinanet", "faster_rcnn", "yolov5")
"""What --train trains where no detector is named."""

_REFERENCE_ATTACK_PX = 128
"""The largest images, of one vehicle each, in an attack on reference detectors."""

_CHECK_SCENES = 12

_ONLY_TRAINING = (
    "training_images",
    "validation_images",
    "training_vehicles",
    "parked_share",
    "training_conditions",
    "paints",
    "shapes",
)
"""Sizes that say nothing of detectors that come trained."""


@dataclass(frozen=True)
class DemoSizes(WorldSizes):
    """How much of everything; meant for 6 minutes on 2 CPU cores, and for 20 with training.

    Attributes:
        random_draws: random controls to compare each texture with; with none, the controls that are
            chosen by the detectors and not learnt are left out, too.
        check_scenes: test scenes on which detectors are checked before the attacks; 0 for no check.
            Where not given, 12; but for reference detectors none, as they were checked when they
            were made, unless there are --imagery or --frames to check them on.
    """

    image_px: Annotated[int, Meta(ge=96, le=16_384)] = 160
    training_vehicles: Count = 5
    random_draws: Annotated[int, Meta(ge=0, le=100)] = 10
    check_scenes: WholeNumber | None = None

    def without_training(self) -> DemoSizes:
        """Returns the same for detectors that come trained: next to nothing to learn from."""
        return replace(self, tiles=(1, 1, *self.tiles[2:]), vehicles=(1, 1, *self.vehicles[2:]))


def _training() -> TrainingSettings:
    return TrainingSettings(steps=500, batch_size=8, validate_every=125)


def _attack() -> AttackSettings:
    return AttackSettings(steps=200)


@dataclass(frozen=True)
class Demo:
    """Builds a world, attacks detectors in it, and writes a report.

    The detectors come with skyproof, or are trained here (--train). Stop it whenever you like and
    give the same command again: it goes on after the last finished step.

    Attributes:
        out: run folder; the report goes there.
        imagery: orthophotos to use as ground instead of procedural ones: GeoTIFFs, or JPEG/PNG with
            --gsd; a folder stands for the images in it.
        gsd: metres per pixel of images that do not say it themselves.
        blur_sigma_px: blur of the vehicles: a number of pixels, or "paper" for the paper's 2.4;
            where not given, that of the ground under them.
        frames: real annotated frames to check the detectors on,
            `[NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...]` (COCO, YOLO or DOTA labels), e.g.
            kit/MOS*@0.116#car.
        frame_classes: class names that count as vehicles in frames without classes of their own;
            other classes are ignored, not counted as mistakes.
        train: train the detectors in this world first, instead of taking those that come with
            skyproof.
        detectors: which to attack together: retinanet, faster_rcnn and, with --train, yolov5; where
            not given, all of these.
        seed: decides everything that is drawn.
        device: auto, cpu or cuda.
        sizes: how much of everything.
        training: how every detector is trained, with --train.
        attack: how the texture is learnt.
        cycles: judge the test scenes as Blender Cycles draws them, too; a finished demo goes on
            with that part alone.
        blender: for --cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not
            given, what `make blender` made, then `blender` on the PATH.
    """

    out: Path = Path("runs/demo")
    imagery: tuple[Path, ...] = ()
    gsd: GroundResolution | None = None
    blur_sigma_px: BlurChoice | None = None
    frames: tuple[str, ...] = ()
    frame_classes: tuple[str, ...] = ("car", "minibus")
    train: bool = False
    detectors: tuple[str, ...] = ()
    seed: Seed = 0
    device: str = "auto"
    sizes: DemoSizes = field(default_factory=DemoSizes)
    training: TrainingSettings = field(default_factory=_training)
    attack: AttackSettings = field(default_factory=_attack)
    cycles: bool = False
    blender: Path | None = None

    def run(self) -> None:
        """Does all steps that are not finished yet, and prints where the report lies."""
        from skyproof.assessment.run_folder import RunFolder
        from skyproof.assessment.serial import run_serially
        from skyproof.cli.device import choose_device
        from skyproof.cli.frames import read_frames
        from skyproof.cycles.blender import find_blender

        if self.blender is not None and not self.cycles:
            raise ConfigurationError(
                "--blender says which Blender draws for --cycles; give --cycles too."
            )
        if self.gsd is not None and not self.imagery:
            raise ConfigurationError(
                "--gsd says how many metres a pixel of --imagery has; give --imagery too."
            )
        self._refuse_what_needs_training()
        device = choose_device(self.device)
        check_detectors(self.judges)
        layout = Layout(self.out)
        plan = demo_plan(self, layout)
        # Mistakes are looked for first: they should show before an hour's work, not after it.
        run = RunFolder(self.out, self._config(), plan, self._plan_of)
        if all(step.is_finished() for step in plan.steps):
            say(f"This run is finished. Report: {layout.report.resolve()}")
            return
        if self.cycles:
            find_blender(self.blender)
        read_frames(self.frames, self.frame_classes, GSD_M)
        with alone(self.out):
            # Somebody else may have begun meanwhile.
            run = RunFolder(self.out, self._config(), plan, self._plan_of)
            run.start(str(device))
            detectors = ", ".join(self.judges)
            say(f"skyproof demo on {device}, detectors {detectors}, run folder {self.out}")
            run_serially(plan, run)
            run.finish()
        say_answers(layout, TEXTURES)
        say(f"Report: {layout.report.resolve()}")

    @property
    def judges(self) -> tuple[str, ...]:
        """Names of the detectors: those that were given, or the usual ones."""
        return self.detectors or (TRAINED if self.train else REFERENCE_DETECTORS)

    def _refuse_what_needs_training(self) -> None:
        """Shows a detector that does not come trained, and settings of a training that is none.

        Raises:
            ConfigurationError: there is one, and --train is not given.
        """
        if self.train:
            return
        for name in self.detectors:
            reference_folder(name)
        usual = DemoSizes()
        changed = [
            f"--sizes.{name.replace('_', '-')}"
            for name in _ONLY_TRAINING
            if getattr(self.sizes, name) != getattr(usual, name)
        ]
        if self.training != _training():
            changed.append("--training")
        if changed:
            raise ConfigurationError(
                f"{changed[0]} says how detectors are trained, and without --train none is; give "
                "--train too, or leave it out."
            )

    def _config(self) -> dict[str, object]:
        # Where a run is computed, or what is added to it, changes none of its results.
        no_settings = ("out", "imagery", "device", "cycles", "blender")
        settings = {key: value for key, value in asdict(self).items() if key not in no_settings}
        return {
            "title": "How robust are these vehicle detectors to camouflage?",
            "imagery": [str(path) for path in self.imagery] or "procedural",
            **settings,
            "detectors": list(self.judges),
        }

    def _plan_of(self, config: dict[str, Any]) -> Plan:
        """The steps of the demo that a run folder's config stands for."""
        settings = {key: value for key, value in config.items() if key != "title"}
        if settings.get("imagery") == "procedural":
            settings["imagery"] = []
        # Every demo of before trained its detectors, and had no word for it.
        settings.setdefault("train", True)
        stored: Demo = check_document(
            settings, Demo, str(self.out / "config.json"), "choose another --out"
        )
        here = replace(
            stored, out=self.out, device=self.device, cycles=self.cycles, blender=self.blender
        )
        return demo_plan(here, Layout(self.out))


def demo_plan(demo: Demo, layout: Layout) -> Plan:
    """Returns the demo's steps: two learnt textures, some random ones, judged by all detectors."""
    sizes = demo.sizes if demo.train else demo.sizes.without_training()
    seed = demo.seed
    device = demo.device
    detectors = demo.judges
    check_scenes = sizes.check_scenes
    if check_scenes is None:
        # What reference detectors were found to be when they were made holds for procedural ground.
        check_scenes = _CHECK_SCENES if demo.train or demo.imagery or demo.frames else 0
    checked = detectors if check_scenes else ()
    steps: list[Step] = []
    if not demo.train:
        steps += [reference_step(layout, name, check=not checked) for name in detectors]
    steps += world_steps(
        layout,
        sizes,
        seed,
        splits=RENDERED if demo.train else ("test",),
        imagery=demo.imagery,
        imagery_gsd_m=demo.gsd,
        blur_sigma_px=demo.blur_sigma_px,
        device=device,
    )
    if demo.train:
        training = asdict(demo.training)
        steps += [
            train_step(layout, sizes, name, "slim", training, seed, device=device)
            for name in detectors
        ]
    if checked:
        steps.append(
            check_step(
                layout,
                sizes,
                checked,
                check_scenes,
                1,
                seed,
                frames=demo.frames,
                frame_classes=demo.frame_classes,
                device=device,
            )
        )
    settings = replace(demo.attack, seed=next_seed(seed, demo.attack.seed))
    names = [CamouflageName.parse(text) for text in TEXTURES]
    jobs = [AttackJob(str(name), settings, detectors) for name in names]
    attack_px = sizes.image_px if demo.train else min(sizes.image_px, _REFERENCE_ATTACK_PX)
    controls = [
        str(name.control.with_repeat(draw)) for name in names for draw in range(sizes.random_draws)
    ]
    if controls:
        chosen = [str(control) for name in names for control in name.unlearnt]
        jobs += [AttackJob(control, settings, detectors) for control in chosen]
    steps += [attack_step(layout, job, attack_px, device=device) for job in jobs]
    if controls:
        steps.append(control_step(layout, controls, seed))
    camouflages = [*(job.name for job in jobs), *controls]
    scores = [
        score_step(
            layout,
            sizes,
            "test",
            camouflages,
            detectors,
            seed,
            frames=demo.frames,
            frame_classes=demo.frame_classes,
            device=device,
        )
    ]
    steps += scores
    if demo.cycles:
        rendering = Rendering(renderer="cycles", blender=demo.blender)
        steps.append(render_step(layout, sizes, "test", rendering=rendering, device=device))
        scores.append(
            score_step(
                layout,
                sizes,
                "test-cycles",
                # Every one takes a minute and more there: of random patterns the best will do.
                [job.name for job in jobs],
                detectors,
                seed,
                rendering=rendering,
                device=device,
            )
        )
        steps.append(scores[-1])
    steps.append(report_step(layout, scores, checked))
    return Plan(steps)


def check_detectors(names: Sequence[str], size: str = "slim") -> None:
    """Shows a mistake before the ground is drawn, not when training begins.

    Raises:
        ConfigurationError: a detector is unknown or named twice, or none is named.
    """
    import torch

    from skyproof.detectors.build import build_detector

    if len(set(names)) != len(names) or not names:
        raise ConfigurationError("--detectors expects each detector once, and at least one.")
    for name in names:
        build_detector(name, size, generator=torch.Generator())
