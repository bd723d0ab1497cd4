"""Finds a Blender for the worker: a Python with bpy, or the user's executable."""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from skyproof.errors import ConfigurationError

_WANTED = (4, 5)
_HOW = "run `make blender` in skyproof's checkout, or give --blender the path of a Blender 4.5 LTS"
_ENVIRONMENT = Path(".venv-blender") / "bin" / "python"
_PATIENCE_S = 120


@dataclass(frozen=True)
class Blender:
    """A Python with bpy, or a Blender executable, and its version of Blender, such as "4.5.15"."""

    path: Path
    is_python: bool
    version: str

    def command(self, script: Path, *arguments: str) -> list[str]:
        """Returns the command line that runs a Python script inside Blender."""
        if self.is_python:
            return [str(self.path), str(script), *arguments]
        options = ["--background", "--factory-startup", "--python-exit-code", "1", "--python"]
        return [str(self.path), *options, str(script), "--", *arguments]


def find_blender(path: Path | None = None) -> Blender:
    """Finds the Blender at `path`; if None, the one of `make blender`, then `blender` on the PATH.

    Raises:
        ConfigurationError: there is none, it does not start, or its version is not 4.5.
    """
    chosen = _search() if path is None else Path(path)
    if not chosen.is_file():
        raise ConfigurationError(
            f"--blender expects a Blender or a Python with bpy, but {chosen} is no file; {_HOW}."
        )
    is_python, version = _ask(chosen)
    if version is None:
        raise ConfigurationError(
            f"{chosen} is neither Blender nor a Python in which `import bpy` works; {_HOW}."
        )
    if tuple(map(int, version.split(".")[:2])) != _WANTED:
        raise ConfigurationError(
            f"{chosen} is Blender {version}, but skyproof works with Blender 4.5 LTS; {_HOW}."
        )
    return Blender(chosen, is_python, version)


def worker_environment(environment: dict[str, str], scratch: str | Path) -> dict[str, str]:
    """An environment without this Python's packages, with a folder for Blender's scratch files."""
    kept = {name: environment[name] for name in {*environment} - {"PYTHONPATH", "PYTHONHOME"}}
    return kept | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(scratch))


def _search() -> Path:
    checkout = Path(__file__).resolve().parents[3]
    for folder in (Path.cwd(), checkout):
        # The link is not resolved, because its path identifies a virtual environment.
        if (folder / _ENVIRONMENT).is_file():
            return folder / _ENVIRONMENT
    found = shutil.which("blender")
    if found is None:
        raise ConfigurationError(
            f"Physics-based images need Blender 4.5 LTS, and none was found; {_HOW}."
        )
    return Path(found)


def _ask(path: Path) -> tuple[bool, str | None]:
    """Says whether `path` is a Python, and the version of its Blender; None if there is none."""
    answer = _output([str(path), "--version"])
    is_python = answer.startswith("Python ")
    if is_python:
        answer = _output([str(path), "-c", "import bpy; print('Blender', bpy.app.version_string)"])
    found = re.search(r"^Blender (\d+\.\d+[.\d]*)", answer, re.MULTILINE)
    return is_python, found[1] if found else None


def _output(command: list[str]) -> str:
    try:
        with TemporaryDirectory(prefix="skyproof-blender-") as scratch:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                stdin=subprocess.DEVNULL,
                timeout=_PATIENCE_S,
                env=worker_environment(dict(os.environ), scratch),
            )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout
