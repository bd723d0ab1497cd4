"""A plan is a list of named steps.

Each step has the settings of one command, the files that it needs and the files that it leaves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from skyproof.assessment.run import Step
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.ranges import check_ranges

_MOST_STEPS = 20_000


class Command(Protocol):
    """A command's settings: a frozen dataclass, as the command line parses it."""

    def run(self) -> None:
        """Does the work."""
        ...


def command_step(
    kind: str,
    name: str,
    command: Command,
    inputs: tuple[Path, ...],
    outputs: tuple[Path, ...],
    **more: Any,
) -> Step:
    """Returns a step that one command does; its settings are the step's."""
    return Step(kind, name, outputs, command.run, command, inputs, **more)


def function_step(
    kind: str,
    name: str,
    function: Callable[..., None],
    arguments: Mapping[str, Any],
    inputs: tuple[Path, ...],
    outputs: tuple[Path, ...],
    **more: Any,
) -> Step:
    """Returns a step that one function does; its arguments are the step's settings."""
    work = partial(function, **arguments)
    return Step(kind, name, outputs, work, dict(arguments), inputs, **more)


class Plan:
    """The steps of a run, each after those whose files it needs.

    Attributes:
        steps: in the order in which one process does them.
        threads: CPU threads of each step, where steps run side by side.
        resources: what each step that computes much asks of a cluster: gpu, mem_mb, runtime
            (minutes).

    Raises:
        ConfigurationError: a command's setting is out of its range, or there are too many steps.
        RunFolderError: two steps of one name, or a step that needs what only a later one leaves.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        *,
        threads: int = 1,
        resources: Mapping[str, int] | None = None,
    ) -> None:
        self.steps = tuple(steps)
        if len(self.steps) > _MOST_STEPS:
            raise ConfigurationError(
                f"The plan has {len(self.steps):,} steps, more than the {_MOST_STEPS:,} that a run "
                "may have; ask for fewer repeats, draws, textures or magnitudes."
            )
        # A setting that a later step would refuse shows before anything is made.
        for step in self.steps:
            if is_dataclass(step.settings):
                check_ranges(step.settings)
        self.threads = threads
        self.resources = dict(resources or {})
        repeated = [name for name, count in Counter(step.id for step in steps).items() if count > 1]
        if repeated:
            raise RunFolderError(f"Two steps of the plan are called {repeated[0]}; rename one.")
        self._made_by = {output: step for step in steps for output in step.outputs}
        made: set[Path] = set()
        for step in steps:
            early = [path for path in step.inputs if path in self._made_by and path not in made]
            if early:
                raise RunFolderError(
                    f"The step {step.id} needs {early[0]}, which only {self._made_by[early[0]].id} "
                    "leaves; put that step first."
                )
            made |= set(step.outputs)

    @property
    def waiting(self) -> dict[str, int]:
        """How many steps wait for each, at first or second hand, by id.

        Where steps run side by side, that with the most comes first: nothing else can be done while
        a detector is trained that all attacks need.
        """
        # One bit for each step that waits.
        waiting = dict.fromkeys((step.id for step in self.steps), 0)
        for number, step in reversed([*enumerate(self.steps)]):
            for path in step.inputs:
                if path in self._made_by:
                    waiting[self._made_by[path].id] |= waiting[step.id] | 1 << number
        return {step: bits.bit_count() for step, bits in waiting.items()}

    @property
    def counts(self) -> dict[str, int]:
        """How many steps of each kind there are."""
        return dict(Counter(step.kind for step in self.steps))
