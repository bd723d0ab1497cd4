"""A plan done step by step in this process."""

from __future__ import annotations

from skyproof.assessment.plan import Plan
from skyproof.assessment.run_folder import RunFolder
from skyproof.cli.console import say


def run_serially(plan: Plan, run: RunFolder) -> None:
    """Does every step that is not finished yet, and says how long the rest may take."""
    for number, step in enumerate(plan.steps, 1):
        if step.is_finished():
            continue
        finished = {before.id for before in plan.steps if before.is_finished()}
        seconds = {name: time for name, time in run.seconds().items() if name in finished}
        left_s = plan.time_left_s(seconds)
        about = "" if left_s is None else f" (about {duration(left_s)} left)"
        say(f"[{number}/{len(plan.steps)}] {step.title}{about}")
        run.timed(step, step.command.run)


def duration(seconds: float) -> str:
    """Returns a time in words that suit its length."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{seconds / 3600:.1f} h"
