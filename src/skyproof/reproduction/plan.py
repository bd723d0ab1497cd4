"""A plan is a list of named steps, with the files that each needs and leaves."""

from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from skyproof.assessment.run import Step
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.ranges import check_ranges

_MOST_STEPS = 20_000


class Command(Protocol):
    """Settings of a command: a frozen dataclass, as the command line parses it."""

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
    """Returns a step that one command does.

    Raises:
        ConfigurationError: a setting is out of its range, which shows before anything is made.
    """
    check_ranges(command)
    return Step(kind, name, outputs, command.run, command, inputs, **more)


def function_step(
    kind: str,
    name: str,
    function: str,
    arguments: Mapping[str, Any],
    inputs: tuple[Path, ...],
    outputs: tuple[Path, ...],
    device: str | None = None,
    **more: Any,
) -> Step:
    """Returns a step that one function does, a "module:name" of this room.

    Its arguments are the step's settings; the device is none, because it decides no results. The
    module is imported when the step is done.
    """
    given = arguments if device is None else {**arguments, "device": device}

    def work() -> None:
        module, _, wanted = function.partition(":")
        getattr(import_module(f"skyproof.reproduction.{module}"), wanted)(**given)

    return Step(kind, name, outputs, work, arguments, inputs, **more)


class Plan:
    """The steps of a run, each after those whose files it needs.

    Attributes:
        steps: in the order in which one process does them.
        threads: CPU threads of each step, if steps run side by side.
        resources: resources on a cluster of each step that computes much: gpu, mem_mb, runtime
            (minutes).

    Raises:
        ConfigurationError: there are too many steps.
        RunFolderError: two steps of one name, or a step that needs an output of a later one.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        *,
        threads: int = 1,
        resources: Mapping[str, int] | None = None,
    ) -> None:
        self.steps = tuple(steps)
        self.threads = threads
        self.resources = dict(resources or {})
        if len(steps) > _MOST_STEPS:
            raise ConfigurationError(
                f"The plan has {len(steps):,} steps, more than the {_MOST_STEPS:,} that a run "
                "may have; ask for fewer repeats, draws, textures or magnitudes."
            )
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
        """How many steps wait for each, directly or not, by id.

        The step with the most comes first if steps run side by side: nothing else can be done while
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
    def in_words(self) -> str:
        """The number of steps, in all and of each kind."""
        counts = Counter(step.kind for step in self.steps)
        listed = ", ".join(f"{kind} {count}" for kind, count in counts.items())
        return f"{len(self.steps)} steps ({listed})"
