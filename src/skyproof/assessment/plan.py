"""A plan is a list of named steps.

Each step has the settings of one command, the files that it needs and the files that it leaves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.ranges import check_ranges

# What a process costs before it works, seconds on one core.
START_S = 5.0

_MOST_STEPS = 20_000

# What the efforts are trusted for: how long steps took counts for more once it is longer than this.
_TRUSTED_S = 60.0


@runtime_checkable
class Command(Protocol):
    """A command's settings: a frozen dataclass, as the command line parses it."""

    def run(self) -> None:
        """Does the work."""
        ...


@dataclass(frozen=True)
class Step:
    """One command of a plan.

    Attributes:
        kind: what is done: "train", "attack". It groups steps in tables of times.
        name: what it is done to; kind and name together are unique in a plan.
        command: the settings of the command.
        inputs: files and folders that must be there before.
        outputs: files and folders that it leaves. A step whose outputs are there is finished.
        growing: whether the outputs lie in folders that a stopped step leaves half-filled, to go on
            from there; otherwise an output appears whole or not at all.
        renewed: whether the step is done again when an input is newer than its outputs. All other
            steps are kept for good, whatever their times say.
        effort_s: about how long it takes on one core. Only the share of the whole counts: for the
            time left.
    """

    kind: str
    name: str
    command: Command
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]
    growing: bool = False
    renewed: bool = False
    effort_s: float = START_S

    @property
    def id(self) -> str:
        """Kind and name, such as "train/retinanet"."""
        return f"{self.kind}/{self.name}"

    @property
    def title(self) -> str:
        """Kind and name for people to read: "train retinanet", "ground"."""
        return self.kind if self.kind == self.name else f"{self.kind} {self.name}"

    def is_begun(self) -> bool:
        """Says whether it has left anything that the next try would go on from."""
        places = [output.parent if self.growing else output for output in self.outputs]
        return any(place.exists() for place in places)

    def is_finished(self) -> bool:
        """Says whether its outputs are there, and new enough where that counts."""
        if not all(output.exists() for output in self.outputs):
            return False
        if not self.renewed:
            return True
        oldest = min(output.stat().st_mtime_ns for output in self.outputs)
        return all(path.stat().st_mtime_ns <= oldest for path in self.inputs if path.exists())


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
            check_ranges(step.command)
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

    def time_left_s(self, seconds: Mapping[str, float], cores: int = 1) -> float | None:
        """Guesses how long the rest will take, from the steps that are finished.

        Args:
            seconds: by step id, how long finished steps took.
            cores: how many steps run side by side.

        Returns:
            Seconds; None before the first step has finished.
        """
        done = [step for step in self.steps if step.id in seconds]
        if not done:
            return None
        took_s = sum(seconds[step.id] for step in done)
        speed = (_TRUSTED_S + took_s) / (_TRUSTED_S + sum(step.effort_s for step in done))
        rest_s = sum(step.effort_s for step in self.steps if step.id not in seconds)
        return speed * rest_s / cores
