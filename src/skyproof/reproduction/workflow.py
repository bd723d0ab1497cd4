"""The plan of a reproduction: every attack of the paper with its random controls, scored by all."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from skyproof.assessment.run import Step
from skyproof.cycles.settings import Rendering
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.layout import Layout
from skyproof.reproduction.held_out_detectors import stored_tables
from skyproof.reproduction.jobs import Jobs
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.plan import Plan
from skyproof.reproduction.preset import Preset
from skyproof.reproduction.steps import Steps
from skyproof.reproduction.world import RENDERED, Rendered
from skyproof.seeds import next_seed


def plan_of_run(device: str = "auto", blender: Path | str | None = None, **others: object) -> Plan:
    """Returns the plan of the run in the current folder, as its `config.json` has it.

    The held-out detectors are those that lie in the folder. Device and Blender may change from call
    to call.

    Raises:
        ConfigurationError: a setting is missing, unknown, or cannot be.
        StoredFileError: there is no `config.json`, or it is damaged.
    """
    if others:
        raise ConfigurationError(
            f"Snakemake's --config takes device and blender, got {', '.join(others)}; leave it out."
        )
    layout = PaperLayout(Path())
    values: dict[str, Any] = read_document(
        layout.config, dict[str, Any], "copy the preset there, or give another folder"
    )
    return reproduction_plan(
        Preset.parse(values, "The run's config.json"),
        layout.folder,
        device=device,
        blender=Path(blender) if blender else None,
        held_out=stored_tables(layout),
    )


def reproduction_plan(
    preset: Preset,
    folder: Path,
    *,
    device: str = "auto",
    blender: Path | None = None,
    held_out: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Plan:
    """Returns a preset, expanded to steps.

    Args:
        preset: settings of the reproduction.
        folder: the run folder, as the steps are to name it.
        device: auto, cpu or cuda.
        blender: Blender that draws the Cycles column; None for a plan without it.
        held_out: held-out detectors by table.
    """
    layout = PaperLayout(folder)
    jobs = Jobs(preset)
    make = Steps(preset, layout, device)
    cycles = None
    if blender is not None:
        cycles = Rendering(renderer="cycles", blender=blender, workers=preset.threads)

    trained = [name for name in preset.detectors if name not in preset.reference]
    splits: tuple[Rendered, ...] = (*(RENDERED if trained else ("test",)), "empty")
    steps = [make.ground(), make.fleets(), *map(make.scenes, splits), *map(make.render, splits)]
    steps += [make.train(name, preset.seed) for name in trained]
    checked = trained if preset.check_scenes else []
    if checked:
        steps.append(make.precheck(checked))
    steps.append(make.controls(jobs.controls))
    steps += map(make.attack, (*jobs.attacks.values(), *jobs.chosen.values()))
    steps += [make.controls(names, texture) for texture, names in jobs.shapes.items()]
    if cycles:
        steps.append(make.render("test", cycles))
    if jobs.weather_batches:
        steps += [make.scenes("weather"), make.render("weather")]

    scores = [*_score_steps(make, jobs, layout, cycles, held_out)]
    if jobs.looked_at:
        scores.append(make.looks(jobs.looked_at))
    if jobs.featured:
        scores.append(make.features(jobs.featured))
    steps += scores
    for number in range(1, preset.trainings):
        further = [*_training_steps(preset, jobs, layout, number, device)]
        steps += further
        scores += [step for step in further if step.kind == "score"]
    steps.append(make.report(scores, checked))
    # No step leaves what comes with skyproof: it is copied before the first one.
    given = {layout.detector(name) / "detector.json" for name in preset.reference}
    steps = [
        replace(step, inputs=tuple(path for path in step.inputs if path not in given))
        for step in steps
    ]
    return Plan(steps, threads=preset.threads, resources=preset.resources.asked())


def _score_steps(
    make: Steps,
    jobs: Jobs,
    layout: PaperLayout,
    cycles: Rendering | None,
    held_out: Mapping[str, Sequence[str]],
) -> Iterator[Step]:
    """The scores of the attacked detectors, of the held-out ones, and those in weather."""
    for number, (name, folders) in enumerate(jobs.batches.items()):
        yield make.score(name, folders, detectors=make.detectors, out=layout, empty=not number)
    tables: dict[str, tuple[Layout, Sequence[Path], Mapping[str, tuple[str, ...]]]]
    tables = {"": (layout, make.detectors, {})}
    for table, names in held_out.items():
        own = layout.table(table)
        # No table's name has a dot, so that no two steps have one name.
        tables[f"judges.{table}."] = (own, tuple(map(own.detector, names)), jobs.held_out_batches)
    for prefix, (out, detectors, batches) in tables.items():
        for name, folders in batches.items():
            yield make.score(name, folders, detectors=detectors, out=out, prefix=prefix)
        if cycles is None:
            continue
        for name, folders in jobs.cycles_batches.items():
            yield make.score(
                f"cycles-{name}",
                folders,
                detectors=detectors,
                out=out,
                prefix=prefix,
                rendering=cycles,
            )
    for name, folders in jobs.weather_batches.items():
        yield make.score(
            name,
            folders,
            detectors=make.detectors,
            out=layout.weather,
            prefix="weather-",
            split="weather",
        )


def _training_steps(
    preset: Preset, jobs: Jobs, layout: PaperLayout, number: int, device: str
) -> Iterator[Step]:
    """The steps of one more training, from detectors to scores.

    Detectors learn from the same images by the same recipe, and attacks go as they went on the
    run's own detectors, but all from other seeds. Random controls are drawn once for all trainings.
    """
    make = Steps(preset, layout, device, number)
    steps = [make.train(name, next_seed(preset.seed, number)) for name in preset.detectors]
    repeats = max([preset.repeats, *preset.texture_repeats.values()])
    for job in jobs.repeated:
        # Every repeat on every training has a seed of its own.
        seed = next_seed(job.settings.seed, number * repeats)
        settings = replace(job.settings, seed=seed, keep_at=())
        steps.append(make.attack(replace(job, settings=settings, kept=())))
    steps += [
        make.score(name, folders, detectors=make.detectors, out=layout.training(number))
        for name, folders in jobs.repeated_batches.items()
    ]
    for step in steps:
        yield replace(step, name=f"training-{number}-{step.name}")
