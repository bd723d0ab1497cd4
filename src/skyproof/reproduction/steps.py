"""The steps of a reproduction: the command of each, and what it leaves."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from skyproof.assessment.run import (
    ATTACK_S,
    CONTROL_S,
    DETECT_S,
    GROUND_S,
    RENDER_S,
    START_S,
    VEHICLE_S,
    Step,
    precheck_images,
)
from skyproof.attacks.settings import AttackSettings
from skyproof.cli.attack import Attack
from skyproof.cli.ground import Ground
from skyproof.cli.precheck import Precheck
from skyproof.cli.render import Render, draw_scenes
from skyproof.cli.score import Score
from skyproof.cli.train import Train
from skyproof.cli.vehicles import Vehicles
from skyproof.cycles.settings import Rendering
from skyproof.detectors.settings import TRAINING_PRESETS
from skyproof.imagery.settings import tiling_for_images
from skyproof.layout import Layout
from skyproof.ranges import check_ranges
from skyproof.reproduction.jobs import AttackJob
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.preset import MOST_SCENES, Preset, Rendered
from skyproof.scenes.splits import Split

_TRAIN_S = 2.0
"""Estimated seconds on one core for a million pixels."""
_TORCH = Rendering()


def command_step(kind: str, name: str, command: Any, *outputs: Path, **more: Any) -> Step:
    """Returns a step that one command does; its output is the command's `out` if none is given."""
    check_ranges(command)
    return Step(kind, name, outputs or (command.out,), command.run, command, **more)


def _function_step(
    kind: str,
    name: str,
    function: Callable[..., object],
    settings: Mapping[str, Any],
    *outputs: Path,
    **more: Any,
) -> Step:
    """Returns a step that one function does, whose arguments are the settings."""
    work = partial(function, **settings)
    return Step(kind, name, outputs or (settings["out"],), work, settings, **more)


def _later(module: str, function: str, **arguments: Any) -> None:
    """Calls a function of this package, whose module is imported only now."""
    getattr(import_module(f"skyproof.reproduction.{module}"), function)(**arguments)


class Steps:
    """Makes a preset's steps in a run folder."""

    def __init__(self, preset: Preset, run: PaperLayout, device: str) -> None:
        self._preset = preset
        self._sizes = preset.world
        self._run = run
        self._device = device
        self._test: dict[str, Any] = {"backgrounds": run.backgrounds, "fleet": run.fleets / "test"}

    @property
    def detectors(self) -> tuple[Path, ...]:
        """The folders of the attacked detectors."""
        return tuple(map(self._run.detector, self._preset.detectors))

    def ground(self) -> Step:
        """Draws ground."""
        sizes = self._sizes
        tiling = tiling_for_images(sizes.image_px, gsd_m=sizes.gsd_m, imagery=False)
        command = Ground(
            out=self._run.backgrounds,
            tiles=sizes.tiles,
            blur_sigma_px=self._preset.blur_sigma_px,
            seed=self._preset.seed,
            tiling=tiling,
        )
        effort_s = START_S + GROUND_S * sum(sizes.tiles) * tiling.size_px**2 / 1e6
        return command_step("ground", "ground", command, effort_s=effort_s)

    def fleets(self) -> Step:
        """Draws the four fleets."""
        sizes = self._sizes
        command = Vehicles(
            out=self._run.fleets,
            counts=sizes.vehicles,
            seed=self._preset.seed,
            paints=sizes.paints,
            shapes=sizes.shapes,
        )
        effort_s = START_S + VEHICLE_S * sum(sizes.vehicles)
        return command_step("vehicles", "fleets", command, effort_s=effort_s)

    def scenes(self, split: Rendered) -> Step:
        """Draws the scenes of a split."""
        ground = _ground_of(split)
        settings = {
            "backgrounds": self._run.backgrounds,
            "fleet": self._run.fleets / ground,
            "out": self._run.scenes(split),
            "split": ground,
            "count": self._count(split),
            "settings": self._sizes.scenes(split),
            "seed": self._preset.seed,
        }
        return _function_step("scenes", split, draw_scenes, settings)

    def render(self, split: Rendered, rendering: Rendering = _TORCH) -> Step:
        """Renders a split without camouflage."""
        run = self._run
        name = _rendered(split, rendering)
        command = Render(
            **vars(rendering),
            scenes=run.scenes(split),
            backgrounds=run.backgrounds,
            fleet=run.fleets / _ground_of(split),
            out=run.dataset(name),
            device=self._device,
        )
        effort_s = self._effort_s(RENDER_S[rendering.renderer], self._count(split))
        extra = rendering.renderer == "cycles"
        return command_step("render", name, command, extra=extra, effort_s=effort_s)

    def train(self, name: str) -> Step:
        """Trains one detector on the rendered images."""
        preset = self._preset
        changes = preset.training.get(name, {})  # type: ignore[call-overload]
        command = Train(
            detector=name,
            data=(self._run.dataset("train"),),
            validation=self._run.dataset("validation"),
            out=self._run.detector(name),
            size=preset.size,
            settings=changes,
            seed=self._preset.seed,
            device=self._device,
        )
        settings = replace(TRAINING_PRESETS[name, preset.size], **changes)
        effort_s = self._effort_s(_TRAIN_S, settings.steps * settings.batch_size)
        card = command.out / "detector.json"
        return command_step("train", name, command, card, growing=True, effort_s=effort_s)

    def precheck(self, names: Sequence[str]) -> Step:
        """Prechecks the detectors of these names."""
        preset, run = self._preset, self._run
        scenes = min(preset.check_scenes, self._sizes.test_images)
        command = Precheck(
            **self._test,
            detectors=tuple(map(run.detector, names)),
            scenes=run.scenes("test"),
            scenes_count=scenes,
            draws=preset.draws,
            seed=preset.seed,
            device=self._device,
        )
        images = precheck_images(scenes, preset.draws)
        effort_s = self._effort_s(RENDER_S["torch"] + DETECT_S * len(names), images)
        outputs = map(run.precheck, names)
        return command_step("check", "detectors", command, *outputs, effort_s=effort_s)

    def attack(self, job: AttackJob) -> Step:
        """Optimises or chooses one camouflage."""
        run, name = self._run, str(job.name)
        command = Attack(
            names=(name,),
            out=run.camouflages,
            detectors=tuple(map(run.detector, job.detectors)),
            backgrounds=run.backgrounds,
            fleet=run.fleets / "attack",
            texture=run.camouflage(job.texture) if job.texture else None,
            image_px=self._preset.attack_image_px,
            conditions=job.conditions,
            places=self._sizes.test_places,
            draws=job.best_of,
            settings=job.settings,
            device=self._device,
        )
        images = job.settings.images(job.name, job.best_of) * len(job.detectors)
        megapixels = images * self._preset.attack_image_px**2 / 1e6
        kind = "choose" if job.name.choice else "attack"
        return self._camouflages(kind, name, command, ATTACK_S * megapixels)

    def controls(self, names: Sequence[str], texture: str | None = None) -> Step:
        """Draws random controls, or random shapes on the texture of a finished camouflage."""
        command = Attack(
            names=tuple(names),
            out=self._run.camouflages,
            backgrounds=self._run.backgrounds,
            texture=self._run.camouflage(texture) if texture else None,
            settings=AttackSettings(seed=self._preset.seed),
        )
        name = f"shapes-{texture}" if texture else "random"
        return self._camouflages("control", name, command, CONTROL_S * len(names))

    def _camouflages(self, kind: str, name: str, command: Attack, work_s: float) -> Step:
        outputs = [command.out / each / "camouflage.json" for each in command.names]
        effort_s = START_S + work_s
        return command_step(kind, name, command, *outputs, growing=True, effort_s=effort_s)

    def score(
        self,
        name: str,
        camouflages: Sequence[str],
        detectors: Sequence[Path],
        out: Layout,
        *,
        prefix: str = "",
        split: Rendered = "test",
        rendering: Rendering = _TORCH,
        empty: bool = False,
    ) -> Step:
        """Scores camouflages, given by their folders relative to `camouflages/`.

        `out` is the run folder whose `scores/` gets them; `empty` counts alarms on empty ground.
        """
        run = self._run
        grounds = (run.dataset("empty"),) if empty else ()
        command = Score(
            **vars(rendering),
            **self._test,
            detectors=tuple(detectors),
            out=out.score(name),
            original=run.dataset(_rendered(split, rendering)),
            camouflages=tuple(map(self._run.camouflage, camouflages)),
            frames=tuple(f"ground without vehicles={e}@{self._sizes.gsd_m}" for e in grounds),
            frame_classes=("vehicle",) if empty else ("car", "minibus"),
            seed=self._preset.seed,
            device=self._device,
        )
        each_s = RENDER_S[rendering.renderer] + DETECT_S * len(detectors)
        return command_step(
            "score",
            f"{prefix}{name}",
            command,
            inputs=grounds,
            extra=rendering.renderer == "cycles",
            effort_s=self._effort_s(each_s, self._count(split) * (1 + len(camouflages))),
        )

    def looks(self, names: Sequence[str], finished: Sequence[str]) -> Step:
        """Measures what camouflages look like, and the practicality of finished ones."""
        settings = {
            "out": self._run.looks,
            "finished": tuple(map(self._run.camouflage, finished)),
            **self._on_test_scenes(names),
        }
        effort_s = 2 * START_S + CONTROL_S * (len(names) + len(finished))
        function = partial(_later, "measure_looks", "write_looks")
        return _function_step("looks", "looks", function, settings, effort_s=effort_s)

    def features(self, names: Sequence[str]) -> Step:
        """Stores the attacked detectors' features."""
        settings = {
            "out": self._run.features,
            "detectors": self.detectors,
            "seed": self._preset.seed,
            **self._on_test_scenes(names),
        }
        function = partial(_later, "gather_features", "store_features", device=self._device)
        images = min(self._sizes.test_images, MOST_SCENES) * len(names)
        effort_s = self._effort_s(RENDER_S["torch"], images)
        return _function_step("features", "features", function, settings, effort_s=effort_s)

    def report(self, scores: Sequence[Step], checked: Sequence[str]) -> Step:
        """Merges all scores and writes the report."""
        run = self._run
        read = [*map(run.precheck, checked), *(path for step in scores for path in step.outputs)]
        return _function_step(
            "report",
            "report",
            partial(_later, "report", "write_reproduction_report"),
            {"out": run.folder},
            run.results,
            run.report,
            inputs=tuple(read),
            renewed=True,
            effort_s=2 * START_S,
        )

    def _on_test_scenes(self, names: Sequence[str]) -> dict[str, Any]:
        camouflages = tuple(map(self._run.camouflage, names))
        return {"original": self._run.dataset("test"), "camouflages": camouflages, **self._test}

    def _count(self, split: Rendered) -> int:
        counts = {
            "train": self._sizes.training_images,
            "validation": self._sizes.validation_images,
            "weather": self._preset.weather_images,
        }
        return counts.get(split, self._sizes.test_images)

    def _effort_s(self, megapixel_s: float, images: int) -> float:
        return START_S + megapixel_s * images * self._sizes.image_px**2 / 1e6


def _rendered(split: Rendered, rendering: Rendering) -> str:
    """The name of a split's dataset."""
    return split if rendering.renderer == "torch" else f"{split}-{rendering.renderer}"


def _ground_of(split: Rendered) -> Split:
    if split == "empty" or split == "weather":
        return "test"
    return split
