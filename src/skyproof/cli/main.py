"""The command line: one sub-command per job, one sentence per error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
import tyro

from skyproof.cli.bench import Bench
from skyproof.cli.bring import Bring
from skyproof.cli.camouflages import Attack, Control, Measure, Palette, Score
from skyproof.cli.check import Check
from skyproof.cli.clear import Clear, Drop
from skyproof.cli.commands import Evaluate, Report, Train
from skyproof.cli.console import say_error
from skyproof.cli.demo import Demo
from skyproof.cli.imagery import Tile
from skyproof.cli.labels import Labels
from skyproof.cli.plan import Plan
from skyproof.cli.render import Render
from skyproof.cli.reproduce import Reproduce
from skyproof.cli.scenes import Scenes
from skyproof.cli.sensor import SetSensor
from skyproof.cli.tables import Tables
from skyproof.cli.vehicles import Mix, Wrap
from skyproof.cli.world import World
from skyproof.errors import SkyproofError

__all__ = ["run"]

_COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": Demo,
    "world": World,
    "scenes": Scenes,
    "render": Render,
    "train": Train,
    "bring": Bring,
    "palette": Palette,
    "attack": Attack,
    "control": Control,
    "score": Score,
    "measure": Measure,
    "check": Check,
    "evaluate": Evaluate,
    "report": Report,
    "reproduce": Reproduce,
    "tables": Tables,
    "plan": Plan,
    "bench": Bench,
}


def _imagery() -> None:
    """Real imagery: tile it, convert labels, clear it, measure its sensor; see `skyproof imagery --help`."""


def _vehicles() -> None:
    """Fleets from meshes: wrap them onto the template, mix fleets; see `skyproof vehicles --help`."""


_COMMANDS |= {"imagery": _imagery, "vehicles": _vehicles}

# Commands of two words, by their first, which stands in `_COMMANDS` for its line of help alone.
_GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    "imagery": {
        "tile": Tile,
        "labels": Labels,
        "clear": Clear,
        "drop": Drop,
        "sensor": SetSensor,
    },
    "vehicles": {
        "wrap": Wrap,
        "mix": Mix,
    },
}


def run(arguments: Sequence[str] | None = None) -> int:
    """Parses and runs one command; returns the exit code: 0 done, 2 bad input, 130 stopped by the user."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        # Settings check themselves while they are parsed.
        if words and words[0] in _GROUPS:
            command = tyro.extras.subcommand_cli_from_dict(
                _GROUPS[words[0]], prog=f"skyproof {words[0]}", args=words[1:]
            )
        else:
            command = tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                prog="skyproof",
                description="How robust is an overhead vehicle detector to camouflage, and how sure is that number?",
                args=words,
            )
        command.run()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except SkyproofError as error:
        say_error(str(error))
        return 2
    except OSError as error:
        say_error(
            f"{error.filename or 'A file'} cannot be used: {error.strerror or error}; check it and try again."
        )
        return 2
    except torch.OutOfMemoryError:
        say_error(
            "the device's memory is full; lower the batch size or the image size, or give --device cpu."
        )
        return 2
    except KeyboardInterrupt:
        say_error("stopped; give the same command again to go on.")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(run())
