"""One step of a reproduction in a process of its own, by its name."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from skyproof.errors import RunFolderError


@dataclass(frozen=True)
class OneStep:
    """Does one step of the reproduction in the current folder, as its `config.json` has it.

    Attributes:
        name: kind and name of the step, such as attack/T-U-0; logs/ is ordered by them.
        device: auto, cpu or cuda.
        blender: Blender of the Cycles column; without it that column has no steps.
    """

    name: Positional[str]
    device: str = "auto"
    blender: Path | None = None

    def run(self) -> None:
        """Does the step, whether or not it is finished."""
        from skyproof.reproduction.workflow import plan_of_run

        steps = plan_of_run(self.device, self.blender).steps
        step = next((step for step in steps if step.id == self.name), None)
        if step is None:
            raise RunFolderError(
                f"The run has no step {self.name!r}; give one of its {len(steps)}, such as "
                f"{steps[0].id}."
            )
        step.work()
