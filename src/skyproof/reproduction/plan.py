"""The plan of a reproduction: every attack of the paper with its random controls, scored by all."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from skyproof.assessment.run import Step
from skyproof.cycles.settings import Rendering
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.reproduction.held_out_detectors import stored_tables
from skyproof.reproduction.jobs import Jobs
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.preset import RENDERED, Preset, Rendered
from skyproof.reproduction.steps import Steps

_MOST_STEPS = 20_000


class Plan:
    """The steps of a run in order; each also depends on earlier steps that write where it reads.

    `threads` are those of each step if steps run side by side, `resources` (gpu, mem_mb, runtime in
    minutes) those of each step that computes much on a cluster.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        threads: int = 1,
        resources: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.threads = threads
        self.resources = resources
        if len(steps) > _MOST_STEPS:
            raise ConfigurationError(
                f"The plan has {len(steps):,} steps, more than the {_MOST_STEPS:,} that a run "
                "may have; ask for fewer repeats, draws, textures or magnitudes."
            )
        repeated = [name for name, count in Counter(step.id for step in steps).items() if count > 1]
        if repeated:
            raise RunFolderError(f"Two steps of the plan are called {repeated[0]}; rename one.")
        left: dict[Path, Path] = {}
        linked = []
        for step in steps:
            inputs = (*step.inputs, *(left[path] for path in _named(step) if path in left))
            linked.append(replace(step, inputs=tuple(dict.fromkeys(inputs))))
            left |= dict(zip(step.places, step.outputs, strict=True))
        self.steps = tuple(linked)

    @property
    def waiting(self) -> dict[str, int]:
        """Returns by id how many steps wait for each, directly or not; Snakemake's priority."""
        made_by = {output: step.id for step in self.steps for output in step.outputs}
        # One bit for each step that waits.
        waiting = dict.fromkeys((step.id for step in self.steps), 0)
        for number, step in reversed([*enumerate(self.steps)]):
            for path in step.inputs:
                if path in made_by:
                    waiting[made_by[path]] |= waiting[step.id] | 1 << number
        return {step: bits.bit_count() for step, bits in waiting.items()}

    @property
    def in_words(self) -> str:
        """The number of steps, in all and of each kind."""
        counts = Counter(step.kind for step in self.steps)
        listed = ", ".join(f"{kind} {count}" for kind, count in counts.items())
        return f"{len(self.steps)} steps ({listed})"


def _named(step: Step) -> Iterator[Path]:
    """The paths that a step's settings name, each with the folders around it."""
    settings = step.settings if isinstance(step.settings, Mapping) else vars(step.settings)
    for value in settings.values():
        for path in value if isinstance(value, tuple) else (value,):
            if isinstance(path, Path):
                yield from (path, *path.parents)


def plan_of_run(device: str = "auto", blender: Path | str | None = None, **others: object) -> Plan:
    """Returns the plan of the run in the current folder, by its `config.json` and its detectors."""
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
    """Returns a preset, expanded to steps; without Blender there is no Cycles column."""
    layout = PaperLayout(folder)
    jobs = Jobs(preset)
    make = Steps(preset, layout, device)
    cycles = None
    if blender is not None:
        cycles = Rendering(renderer="cycles", blender=blender, workers=preset.threads)

    trained = [name for name in preset.detectors if name not in preset.reference]
    splits: tuple[Rendered, ...] = (*(RENDERED if trained else ("test",)), "empty")
    steps = [make.ground(), make.fleets(), *map(make.scenes, splits), *map(make.render, splits)]
    steps += [make.train(name) for name in trained]
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
        scores.append(make.looks(jobs.looked_at, jobs.pictured))
    if jobs.featured:
        scores.append(make.features(jobs.featured))
    steps += scores
    steps.append(make.report(scores, checked))
    asked = vars(preset.resources).items()
    return Plan(steps, preset.threads, {name: each for name, each in asked if each is not None})


def _score_steps(
    make: Steps,
    jobs: Jobs,
    layout: PaperLayout,
    cycles: Rendering | None,
    held_out: Mapping[str, Sequence[str]],
) -> Iterator[Step]:
    """The scores of the attacked detectors, of the held-out ones, and those in weather."""
    own = ("", layout, make.detectors, jobs.batches)
    tables = {table: layout.table(table) for table in held_out}
    others = [
        # No table's name has a dot, so that no two steps have one name.
        (f"judges.{table}.", its, tuple(map(its.detector, held_out[table])), jobs.held_out_batches)
        for table, its in tables.items()
    ]
    for prefix, out, detectors, batches in (own, *others):
        for name, folders in batches.items():
            first = name == "000"
            yield make.score(name, folders, detectors, out, prefix=prefix, empty=first)
        if cycles is not None:
            for name, folders in jobs.cycles_batches.items():
                name = f"cycles-{name}"
                yield make.score(name, folders, detectors, out, prefix=prefix, rendering=cycles)
    for name, folders in jobs.weather_batches.items():
        yield make.score(
            name, folders, make.detectors, layout.weather, prefix="weather-", split="weather"
        )
