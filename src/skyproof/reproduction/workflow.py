"""The plan of a reproduction: every attack of the paper with its random controls, scored by all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from skyproof.assessment.run import START_S, Step
from skyproof.cycles.settings import Rendering
from skyproof.documents import read_document
from skyproof.layout import Layout
from skyproof.reproduction.further_trainings import training_steps
from skyproof.reproduction.held_out_detectors import stored_judges
from skyproof.reproduction.jobs import Jobs
from skyproof.reproduction.own_steps import store_features, write_looks, write_report
from skyproof.reproduction.plan import Plan, function_step
from skyproof.reproduction.preset import Preset
from skyproof.reproduction.steps import (
    attack_step,
    check_step,
    control_step,
    score_step,
    train_step,
)
from skyproof.reproduction.world import RENDERED, render_s, render_step, scene_step, world_steps

_LOOK_S = 0.1
_MOST_SCENES = 200


def plan_of_run(device: str = "auto", blender: Path | str | None = None) -> Plan:
    """Returns the plan of the run in the current folder, as its `config.json` has it.

    The held-out detectors are those that lie in the folder. Device and Blender may change from call
    to call.

    Raises:
        ConfigurationError: a setting is missing, unknown, or cannot be.
        StoredFileError: there is no `config.json`, or it is damaged.
    """
    layout = Layout(Path())
    values: dict[str, Any] = read_document(
        layout.config, dict[str, Any], "copy the preset there, or give another folder"
    )
    return reproduction_plan(
        Preset.parse(values, "The run's config.json"),
        layout.folder,
        device=device,
        blender=Path(blender) if blender else None,
        judges=stored_judges(layout),
    )


def reproduction_plan(
    preset: Preset,
    folder: Path,
    *,
    device: str = "auto",
    blender: Path | None = None,
    judges: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Plan:
    """Returns a preset, expanded to steps.

    Args:
        preset: what is reproduced.
        folder: the run folder, as the steps are to name it.
        device: auto, cpu or cuda.
        blender: Blender that draws the Cycles column; None for a plan without it.
        judges: by table, the detectors that only judge.
    """
    layout = Layout(folder)
    sizes = preset.world
    jobs = Jobs(preset)
    trained = [name for name in preset.detectors if name not in preset.reference]
    steps = world_steps(
        layout,
        sizes,
        preset.seed,
        splits=(*(RENDERED if trained else ("test",)), "empty"),
        blur_sigma_px=preset.blur_sigma_px,
        device=device,
    )
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

    def score(
        name: str,
        folders: Sequence[str],
        rendering: Rendering | None = None,
        table: str | None = None,
    ) -> None:
        scores.append(
            score_step(
                layout,
                sizes,
                name,
                folders,
                judges[table] if table else preset.detectors,
                preset.seed,
                empty=not scores,
                rendering=rendering,
                judged=layout.judged(table) if table else None,
                device=device,
            )
        )

    for name, folders in jobs.batches.items():
        score(name, folders)
    rendering = None
    if blender is not None:
        rendering = Rendering(renderer="cycles", blender=blender, workers=preset.threads)
        steps.append(render_step(layout, sizes, "test", rendering=rendering, device=device))
        for name, folders in jobs.cycles_batches.items():
            score(f"cycles-{name}", folders, rendering)
    for table in judges:
        for name, folders in jobs.judged_batches.items():
            score(name, folders, table=table)
        if rendering is not None:
            for name, folders in jobs.cycles_batches.items():
                score(f"cycles-{name}", folders, rendering, table)
    if jobs.weather_batches:
        weather = replace(sizes, test_images=preset.weather_images)
        steps.append(scene_step(layout, weather, "weather", preset.seed))
        steps.append(render_step(layout, weather, "weather", device=device))
        scores += [
            score_step(
                layout,
                weather,
                name,
                folders,
                preset.detectors,
                preset.seed,
                weather=True,
                device=device,
            )
            for name, folders in jobs.weather_batches.items()
        ]
    if jobs.looked_at:
        scores.append(_looks_step(layout, jobs.looked_at))
    if jobs.featured:
        scores.append(_features_step(layout, preset, jobs.featured, device))
    steps += scores
    for number in range(1, preset.trainings):
        further = training_steps(
            layout, preset, number, jobs.repeated, jobs.repeated_batches, device=device
        )
        steps += further
        scores += [step for step in further if step.kind == "score"]
    steps.append(_report_step(layout, scores, checked))
    # No step leaves what comes with skyproof: it is copied before the first one.
    given = {layout.detector(name) / "detector.json" for name in preset.reference}
    steps = [
        replace(step, inputs=tuple(path for path in step.inputs if path not in given))
        for step in steps
    ]
    return Plan(steps, threads=preset.threads, resources=preset.resources.asked())


def _report_step(layout: Layout, scores: Sequence[Step], checked: Sequence[str]) -> Step:
    """Returns the step that merges all scores and writes the report."""
    checks = [layout.precheck(name) for name in checked]
    return function_step(
        "report",
        "report",
        write_report,
        {"out": layout.folder},
        (*checks, *(folder for step in scores for folder in step.outputs)),
        (layout.results, layout.report),
        renewed=True,
        effort_s=2 * START_S,
    )


def _looks_step(layout: Layout, camouflages: Sequence[str]) -> Step:
    """Returns the step that measures what camouflages look like."""
    arguments = {
        "out": layout.folder / "looks",
        "original": layout.dataset("test"),
        "camouflages": tuple(layout.camouflage(name) for name in camouflages),
        "backgrounds": layout.backgrounds,
        "fleet": layout.fleets / "test",
    }
    inputs = [layout.dataset("test"), layout.backgrounds, layout.fleets]
    inputs += [layout.camouflage(name) / "camouflage.json" for name in camouflages]
    return function_step(
        "looks",
        "looks",
        write_looks,
        arguments,
        tuple(inputs),
        (layout.folder / "looks",),
        effort_s=2 * START_S + _LOOK_S * len(camouflages),
    )


def _features_step(layout: Layout, preset: Preset, camouflages: Sequence[str], device: str) -> Step:
    """Returns the step that stores the attacked detectors' features."""
    out = layout.folder / "features.parquet"
    arguments = {
        "detectors": tuple(layout.detector(name) for name in preset.detectors),
        "out": out,
        "original": layout.dataset("test"),
        "camouflages": tuple(layout.camouflage(name) for name in camouflages),
        "backgrounds": layout.backgrounds,
        "fleet": layout.fleets / "test",
        "seed": preset.seed,
    }
    inputs = [layout.dataset("test"), layout.backgrounds, layout.fleets]
    inputs += [layout.detector(name) / "detector.json" for name in preset.detectors]
    inputs += [layout.camouflage(name) / "camouflage.json" for name in camouflages]
    images = min(preset.world.test_images, _MOST_SCENES) * len(camouflages)
    effort_s = START_S + render_s(Rendering()) * preset.world.megapixels(images)
    return function_step(
        "features",
        "features",
        # Settings decide results; a device does not.
        partial(store_features, device=device),
        arguments,
        tuple(inputs),
        (out,),
        effort_s=effort_s,
    )
