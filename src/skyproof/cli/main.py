"""The command line: one sub-command per job, one sentence per error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from skyproof.cli.bench import Bench
from skyproof.cli.commands import Attack, Evaluate, Render, Report, Train
from skyproof.cli.console import say_error
from skyproof.cli.demo import Demo
from skyproof.errors import SkyproofError

__all__ = ["run"]

_COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": Demo,
    "render": Render,
    "train": Train,
    "attack": Attack,
    "evaluate": Evaluate,
    "report": Report,
    "bench": Bench,
}


def run(arguments: Sequence[str] | None = None) -> int:
    """Parses and runs one command; returns the exit code: 0 done, 2 bad input, 130 stopped by the user."""
    command = tyro.extras.subcommand_cli_from_dict(
        _COMMANDS,
        prog="skyproof",
        description="How robust is an overhead vehicle detector against camouflage that could really be built?",
        args=arguments,
    )
    try:
        command.run()
    except SkyproofError as error:
        say_error(str(error))
        return 2
    except KeyboardInterrupt:
        say_error("stopped; give the same command again to go on.")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(run())
