"""The entry point of the `skyproof` command: one sub-command per job, one sentence per error."""

import ctypes
import errno
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any

from skyproof import __version__
from skyproof.console import say, say_error
from skyproof.errors import ConfigurationError, SkyproofError, is_full_memory
from skyproof.ranges import check_ranges

# A command is imported when it is asked for: help and a wrong option must answer at once.
COMMANDS: dict[str, dict[str, str]] = {
    "Whole runs": {
        "demo": "skyproof.assessment.command:Demo",
        "assess": "skyproof.assessment.command:Request",
        "reproduce": "skyproof.reproduction.command:Reproduce",
        "report": "skyproof.cli.report:Report",
    },
    "Ground and vehicles": {
        "ground": "skyproof.cli.ground:Ground",
        "clear": "skyproof.cli.clear:Clear",
        "vehicles": "skyproof.cli.vehicles:Vehicles",
    },
    "Images": {"render": "skyproof.cli.render:Render"},
    "Detectors": {
        "train": "skyproof.cli.train:Train",
        "import": "skyproof.cli.import_detector:Import",
        "precheck": "skyproof.cli.precheck:Precheck",
        "harden": "skyproof.hardening.command:Harden",
    },
    "Attacks and scores": {
        "attack": "skyproof.cli.attack:Attack",
        "score": "skyproof.cli.score:Score",
    },
}

_READER_GONE = 141
_FREE_SPACE = "free space, then give the same command again"
_IN_THE_WAY = "move away what is in its place, or choose another"
_FORBIDDEN = "make it accessible, or choose another"
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FREE_SPACE),
    **dict.fromkeys((errno.EACCES, errno.EPERM), _FORBIDDEN),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR), _IN_THE_WAY),
    errno.EROFS: "choose a place that can be written",
    errno.ENOENT: "check the path",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EISDIR: "give a file, not a folder",
    errno.ELOOP: "check where its links lead",
}
"""What the user can do, by the system's error number."""

Commands = Mapping[str, Mapping[str, str]]
"""The module and class of every command, by group and name."""

_NO_NETWORK = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:1",
    "PROJ_NETWORK": "OFF",
}
"""Keeps GDAL and PROJ off the network, in case a file gets past our checks."""

_QUIET = {"CPL_LOG": os.devnull, "PROJ_DEBUG": "0", "TORCH_CPP_LOG_LEVEL": "ERROR"}
"""Keeps GDAL, PROJ and torch from writing lines to the terminal among our own."""


def main(commands: Commands = COMMANDS) -> None:
    """Runs the command that the program's arguments name."""
    # Many small operations stall when idle threads spin; this must be set before torch is
    # imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.update(_NO_NETWORK)
    # To look for a mistake, set these variables, or ask Python for its warnings.
    for variable, value in _QUIET.items():
        os.environ.setdefault(variable, value)
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    _keep_freed_memory()
    sys.exit(run(commands=commands))


def run(arguments: Sequence[str] | None = None, *, commands: Commands = COMMANDS) -> int:
    """Parses and runs one command; returns the exit code.

    The code is 0 when done, 2 for bad input, 130 after Ctrl-C, 141 when nobody reads the output.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if not words:
            raise SkyproofError("a command is expected; see skyproof --help.")
        if words[0] in ("-h", "--help"):
            say(_overview(commands))
        elif words[0] == "--version":
            say(f"skyproof {__version__}")
        else:
            _parse(words, commands).run()
    except SystemExit as stop:
        if stop.code is None or isinstance(stop.code, int):
            return stop.code or 0
        say_error(str(stop.code))
        return 2
    except KeyboardInterrupt:
        say_error("stopped; give the same command again to go on.")
        return 130
    except BrokenPipeError:
        # Whoever read our words has gone, as `head` does; nothing may be written at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _READER_GONE
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        say_error(sentence)
        return 2
    return 0


def _sentence(error: Exception) -> str | None:
    """Tells a user what went wrong and what to do; None for a mistake in skyproof itself."""
    if isinstance(error, SkyproofError):
        return str(error)
    if isinstance(error, OSError):
        file = error.filename or "a file"
        remedy = _REMEDIES.get(error.errno or 0, "check it and try again")
        return f"{file} cannot be used: {error.strerror or error}; {remedy}."
    if isinstance(error, RecursionError):
        return "a file given here is nested too deep; check the files, and give others."
    if is_full_memory(error):
        return "the memory is full; give smaller files, or use a machine with more of it."
    # Torch may not be loaded.
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(error, torch.OutOfMemoryError):
        return "the device's memory is full; give smaller images, or --device cpu."
    return None


def load_command(name: str, commands: Commands = COMMANDS) -> type[Any]:
    """Imports the class of a command."""
    places = {key: place for group in commands.values() for key, place in group.items()}
    if name not in places:
        raise SkyproofError(
            f"there is no command {name!r}; expected one of {', '.join(places)} (see skyproof "
            "--help)."
        )
    module, _, kind = places[name].partition(":")
    return getattr(import_module(module), kind)


def _parse(words: Sequence[str], commands: Commands) -> Any:
    import tyro

    kind = load_command(words[0], commands)
    try:
        # Nested settings check themselves while they are parsed. Without these two, help texts
        # would offer "{None}|PATH" and "--no-plan".
        plain = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
        command = tyro.cli(kind, prog=f"skyproof {words[0]}", args=words[1:], config=plain)
        check_ranges(command)
    except ConfigurationError as error:
        raise ConfigurationError(_as_typed(str(error), words)) from error
    return command


def _as_typed(message: str, words: Sequence[str]) -> str:
    """Names the option that a message begins with as typed: "steps" becomes "--settings.steps"."""
    field, space, rest = message.partition(" ")
    options = [word.partition("=")[0] for word in words[1:] if word.startswith("--")]
    typed = {option.lstrip("-").rpartition(".")[2].replace("-", "_"): option for option in options}
    return f"{typed[field]}{space}{rest}" if field in typed else message


def _overview(commands: Commands) -> str:
    lines = [
        "usage: skyproof COMMAND [options]",
        "",
        "How robust is an overhead vehicle detector to camouflage, and how sure is that number?",
    ]
    for title, group in commands.items():
        lines += ["", f"{title}:"]
        for name in group:
            # The first sentence of the command's docstring.
            said = (load_command(name, commands).__doc__ or "").strip().split("\n")[0]
            lines.append(f"  {name:<15}{said.rstrip('.')}")
    lines += [
        "",
        "skyproof COMMAND --help lists a command's options; skyproof --version the version.",
    ]
    return "\n".join(lines)


def _keep_freed_memory() -> None:
    """Tells glibc to keep large freed blocks: new ones cost a quarter of the rendering time."""
    trim_threshold = -1
    mmap_threshold = -3
    with suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(trim_threshold, 2**31 - 1)
        library.mallopt(mmap_threshold, 2**30)
