"""The plan of a reproduction: every attack of the paper with its random controls, scored by all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.name import CamouflageName, Order
from skyproof.cli.rendering import Rendering
from skyproof.layout import Layout
from skyproof.plans.plan import Plan, Step
from skyproof.plans.preset import Preset
from skyproof.plans.steps import (
    AttackJob,
    attack_step,
    check_step,
    control_step,
    reference_step,
    report_step,
    score_step,
    train_step,
)
from skyproof.plans.trainings import training_steps
from skyproof.plans.world import render_step, world_steps
from skyproof.seeds import next_seed

__all__ = ["Jobs", "plan_of_config", "reproduction_plan"]

_PARALLEL = ("Fc", "PixFc")


def plan_of_config(config: Mapping[str, Any]) -> Plan:
    """Returns the plan that a run folder's config.json stands for, with paths inside that folder.

    Args:
        config: the preset's values; also "device", "cycles" (1 for the Cycles column) and
            "blender", which are no settings of a run, because they can change from call to call.

    Raises:
        ConfigurationError: a setting is missing, unknown, or cannot be.
    """
    told = {name: config[name] for name in ("device", "cycles", "blender") if name in config}
    settings = {name: value for name, value in config.items() if name not in told}
    blender = told.get("blender")
    return reproduction_plan(
        Preset.parse(settings, "The run's config.json"),
        Path(),
        device=str(told.get("device", "auto")),
        cycles=str(told.get("cycles", 0)) == "1",
        blender=Path(str(blender)) if blender else None,
    )


def reproduction_plan(
    preset: Preset,
    folder: Path,
    *,
    device: str = "auto",
    cycles: bool = False,
    blender: Path | None = None,
) -> Plan:
    """Returns a preset, expanded to steps.

    Args:
        preset: what is reproduced.
        folder: the run folder, as the steps are to name it.
        device: auto, cpu or cuda.
        cycles: whether finished attacks and random controls are also scored on Cycles.
        blender: which Blender draws them.
    """
    layout = Layout(folder)
    sizes = preset.world
    jobs = Jobs(preset)
    steps = world_steps(
        layout, sizes, preset.seed, blur_sigma_px=preset.blur_sigma_px, device=device
    )
    steps += [reference_step(layout, name, check=True) for name in preset.reference]
    trained = [name for name in preset.detectors if name not in preset.reference]
    steps += [
        train_step(
            layout,
            sizes,
            name,
            preset.size,
            preset.training.get(name, {}),
            preset.seed,
            device=device,
        )
        for name in trained
    ]
    checked = trained if preset.check_scenes else []
    if checked:
        steps.append(
            check_step(
                layout,
                sizes,
                checked,
                preset.check_scenes,
                preset.draws,
                preset.seed,
                device=device,
            )
        )
    steps.append(control_step(layout, jobs.controls, preset.seed))
    steps += [
        attack_step(layout, job, preset.attack_image_px, places=sizes.test_places, device=device)
        for job in (*jobs.attacks.values(), *jobs.chosen.values())
    ]
    steps += [
        control_step(layout, names, preset.seed, texture=texture)
        for texture, names in jobs.shapes.items()
    ]
    scores: list[Step] = []

    def score(name: str, folders: Sequence[str], rendering: Rendering | None = None) -> None:
        scores.append(
            score_step(
                layout,
                sizes,
                name,
                folders,
                preset.detectors,
                preset.seed,
                rendering=rendering,
                device=device,
            )
        )

    for name, folders in jobs.batches.items():
        score(name, folders)
    if cycles:
        rendering = Rendering(renderer="cycles", blender=blender, workers=preset.threads)
        steps.append(render_step(layout, sizes, "test", rendering=rendering, device=device))
        for name, folders in jobs.cycles_batches.items():
            score(f"cycles-{name}", folders, rendering)
    steps += scores
    for number in range(1, preset.trainings):
        further = training_steps(
            layout, preset, number, jobs.repeated, jobs.repeated_batches, device=device
        )
        steps += further
        scores += [step for step in further if step.kind == "score"]
    steps.append(report_step(layout, scores, checked))
    return Plan(steps, threads=preset.threads, resources=preset.resources.asked())


@dataclass(frozen=True)
class _Kind:
    """One camouflage to be learnt, before it is repeated."""

    name: CamouflageName
    kind: str
    detectors: tuple[str, ...]


class Jobs:
    """What a preset attacks, draws and scores.

    Attributes:
        attacks: the learnt camouflages, by name.
        controls: names of all random draws.
        chosen: the controls that are chosen by the detectors and not learnt, by name.
        shapes: names of random shapes, by the finished attack on whose texture they are put.
        batches: what is scored together: names of score folders to folders of camouflages, relative
            to `camouflages/`. Controls come first: they wait for no attack.
        repeated: the attacks on all detectors, which are made again on every further training.
        repeated_batches: what is scored together there: random controls, and these attacks as they
            finally are.
        cycles_batches: what is scored together on Cycles: random controls and finished attacks on
            all detectors, as in the paper's "Blender" column.
    """

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        self._textures = [TextureConstraints.parse(text) for text in preset.textures]
        repeats = range(preset.repeats)
        jobs = [self._job(kind, repeat) for repeat in repeats for kind in self._kinds()]
        self.attacks = {job.name: job for job in jobs}
        self.controls = tuple(
            str(name.with_repeat(draw)) for name in self._controls() for draw in range(preset.draws)
        )
        self.chosen = {job.name: job for job in self._chosen()}
        self.shapes = self._shapes()
        folders = [folder for job in jobs for folder in job.folders]
        late = [*self.chosen, *(name for names in self.shapes.values() for name in names)]
        self.batches = self._batched(self.controls, folders, late)
        finished = [name for name in self.attacks if not CamouflageName.parse(name).variant]
        self.repeated = tuple(self.attacks[name] for name in finished)
        self.repeated_batches = self._batched(self.controls, finished)
        self.cycles_batches = self._batched(self._first(self.controls), self._first(finished))

    def _kinds(self) -> Iterator[_Kind]:
        preset = self._preset
        every = preset.detectors
        for texture in self._textures:
            yield _Kind(CamouflageName("texture", texture), "texture", every)
        for text in preset.transfer:
            name = CamouflageName.parse(text)
            for variant, detectors in _parts_of(every):
                yield _Kind(name.with_variant(variant), "texture", detectors)
        for magnitude in preset.magnitudes:
            yield _Kind(CamouflageName("shape", magnitude=magnitude), "shape", every)
        orders: tuple[tuple[Order, str], ...] = (("seq", "sequential"), ("par", "parallel"))
        for order, kind in orders:
            for texture in self._textures:
                if order == "par" and texture.name not in _PARALLEL:
                    continue
                for magnitude in self._grid(texture):
                    name = CamouflageName("combination", texture, magnitude, order)
                    yield _Kind(name, kind, every)

    def _controls(self) -> Iterator[CamouflageName]:
        for texture in self._textures:
            yield CamouflageName("texture", texture).control
        for magnitude in self._preset.magnitudes:
            yield CamouflageName("shape", magnitude=magnitude).control
        for texture in self._textures:
            for magnitude in self._grid(texture):
                yield CamouflageName("combination", texture, magnitude, "seq").control

    def _grid(self, texture: TextureConstraints) -> tuple[float, ...]:
        preset = self._preset
        return preset.combined_magnitudes.get(texture.name, preset.magnitudes)

    def _job(self, kind: _Kind, repeat: int) -> AttackJob:
        preset = self._preset
        name = kind.name.with_repeat(repeat)
        steps: int = getattr(preset.attack_steps, kind.kind)
        measured = name.magnitude in (None, preset.ladder_magnitude)
        climbs = repeat == 0 and not name.variant and measured
        rungs = [step for step in preset.ladder_steps if step < steps] if climbs else []
        kept = [str(name.with_variant(f"step{step}")) for step in rungs]
        learns_colours = name.constraints is not None and name.constraints.colours != "free"
        if rungs and learns_colours and name.order != "seq":
            kept.append(str(name.with_variant("relaxed")))
        texture = None
        if name.order == "seq":
            texture = str(CamouflageName("texture", name.constraints).with_repeat(repeat))
        return AttackJob(
            name=str(name),
            settings=replace(
                preset.attack,
                steps=steps,
                seed=next_seed(preset.seed, repeat),
                keep_at=tuple(rungs),
            ),
            detectors=kind.detectors,
            texture=texture,
            kept=tuple(kept),
        )

    def _first(self, names: Sequence[str]) -> list[str]:
        """The repeats and draws that the Cycles column has."""
        count = self._preset.cycles_repeats
        return [name for name in names if int(CamouflageName.parse(name).repeat) < count]

    def _chosen(self) -> Iterator[AttackJob]:
        """The choices that stand beside the attacks, with as many steps as the longest of them."""
        preset = self._preset
        if not preset.best_of:
            return
        steps: dict[CamouflageName, int] = {}
        for job in self.attacks.values():
            name = CamouflageName.parse(job.name)
            # Under a sequential shape lies a texture that was learnt, too.
            own = job.settings.steps + (preset.attack_steps.texture if job.texture else 0)
            for control in () if name.variant else name.unlearnt:
                steps[control] = max(own, steps.get(control, 0))
        seed = next_seed(preset.seed, 0)
        for control, count in steps.items():
            settings = replace(preset.attack, steps=count, seed=seed)
            job = AttackJob(str(control), settings, preset.detectors)
            yield replace(job, best_of=preset.best_of)

    def _shapes(self) -> dict[str, list[str]]:
        """Random shapes on the texture of every combination, spread over its repeats.

        At one magnitude alone, as they tell what a learnt shape adds and not how much is best.
        """
        preset = self._preset
        shapes: dict[str, list[str]] = {}
        for job in self.attacks.values() if preset.best_of else ():
            name = CamouflageName.parse(job.name)
            control = name.drawn_shape
            if control is None or name.variant or name.magnitude != preset.ladder_magnitude:
                continue
            # A sequential attack has its texture from another, a parallel one its own.
            draws = range(int(name.repeat), preset.draws, preset.repeats)
            names = [str(control.with_repeat(draw)) for draw in draws]
            shapes.setdefault(job.texture or job.name, []).extend(names)
        return {texture: names for texture, names in shapes.items() if names}

    def _batched(self, *groups: Sequence[str]) -> dict[str, tuple[str, ...]]:
        size = self._preset.score_batch
        batches = [
            tuple(folders[start : start + size])
            for folders in groups
            for start in range(0, len(folders), size)
        ]
        return {f"{number:03d}": batch for number, batch in enumerate(batches)}


def _parts_of(detectors: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Parts of the ensemble that an attack is to transfer from, each with the variant it gives."""
    if len(detectors) > 1:
        for detector in detectors:
            yield f"on_{detector}", (detector,)
    # Of two detectors, all but one is the other one.
    if len(detectors) > 2:
        for left_out in detectors:
            rest = tuple(detector for detector in detectors if detector != left_out)
            yield f"without_{left_out}", rest
