"""Which Blender is taken, and what is said where there is none that works."""

import sys
from pathlib import Path

import numpy as np
import pytest

from skyproof.cycles import blender as module
from skyproof.cycles.blender import Blender, find_blender, worker_environment
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.errors import ConfigurationError
from tests.cycles.stage import one_job
from tests.render.bodies import scene, vehicles


def program(path, text):
    """An executable shell script."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def python_with(path, version):
    """Answers as a Python does whose bpy is of a version; None for one without."""
    answer = "exit 1" if version is None else f"echo 'Blender {version}'"
    return program(path, f'if [ "$1" = --version ]; then echo "Python 3.11.9"; else {answer}; fi')


def blender_of(path, version, more=""):
    """Answers as a Blender executable does, which says more than its version."""
    answer = f"echo 'Blender {version}'; echo '  build date: 2025-09-09'; exit 0"
    return program(path, f'if [ "$1" = --version ]; then {answer}; fi\n{more}')


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A working folder, a checkout and a PATH without Blender."""
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path / "folder")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setattr(
        module, "__file__", str(tmp_path / "checkout/src/skyproof/cycles/blender.py")
    )
    return tmp_path


def test_none_at_all(nowhere):
    with pytest.raises(
        ConfigurationError, match=r"need Blender 4\.5 LTS, and none was found; run `make blender`"
    ):
        find_blender()


def test_the_environment_comes_before_the_path_and_the_working_folder_before_the_checkout(nowhere):
    # Each found while it is the best there is.
    on_path = blender_of(nowhere / "bin/blender", "4.5.3", "PATH=/usr/bin:/bin")
    assert find_blender() == Blender(on_path, False, "4.5.3")
    in_checkout = python_with(nowhere / "checkout/.venv-blender/bin/python", "4.5.15")
    assert find_blender() == Blender(in_checkout, True, "4.5.15")
    in_folder = python_with(nowhere / "folder/.venv-blender/bin/python", "4.5.1 LTS")
    assert find_blender() == Blender(in_folder, True, "4.5.1")
    given = blender_of(nowhere / "mine", "4.5.2 LTS")
    assert find_blender(given) == Blender(given, False, "4.5.2")


def test_a_link_is_not_followed(nowhere):
    """A virtual environment is known by the path it was started under."""
    genuine = python_with(nowhere / "usr/python3.11", "4.5.0")
    link = nowhere / "folder/.venv-blender/bin/python"
    link.parent.mkdir(parents=True)
    link.symlink_to(genuine)
    assert find_blender().path == link


@pytest.mark.parametrize("version", ["3.4.1", "4.4.3", "5.0.0", "4.50.1"])
@pytest.mark.parametrize("make", [blender_of, python_with])
def test_another_version_is_named(tmp_path, make, version):
    path = make(tmp_path / "it", version)
    with pytest.raises(
        ConfigurationError,
        match=rf"it is Blender {version}, but skyproof works with Blender 4\.5 LTS",
    ):
        find_blender(path)


def test_what_is_no_file(tmp_path):
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(ConfigurationError, match=f"{path} is no file; run `make blender`"):
            find_blender(path)


def test_what_is_no_blender(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE_S", 0.5)
    text = tmp_path / "text"
    text.write_text("Blender 4.5.3")
    for path in (
        python_with(tmp_path / "python", None),
        Path(sys.executable),
        Path("/bin/true"),
        program(tmp_path / "other", "echo not Blender 4.5.3"),
        program(tmp_path / "sleeper", "exec sleep 60"),
        text,
    ):
        with pytest.raises(
            ConfigurationError, match="is neither Blender nor a Python in which `import bpy` works"
        ):
            find_blender(path)


def test_command_lines():
    script = Path("/x/worker.py")
    python = Blender(Path("/env/bin/python"), True, "4.5.0").command(script, "/scratch")
    assert python == ["/env/bin/python", "/x/worker.py", "/scratch"]
    executable = Blender(Path("/opt/blender"), False, "4.5.0").command(script, "/scratch")
    options = (
        "--background --factory-startup --python-exit-code 1 --python /x/worker.py -- /scratch"
    )
    assert executable == ["/opt/blender", *options.split()]


def test_the_other_pythons_packages_stay_outside_and_its_own_files_in_scratch():
    given = {"PATH": "/bin", "PYTHONPATH": "/here", "PYTHONHOME": "/there", "TMPDIR": "/tmp"}
    scratch = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), "/scratch")
    assert worker_environment(given, "/scratch") == {"PATH": "/bin"} | scratch


@pytest.mark.blender
def test_the_found_one_is_a_python_of_4_5(blender):
    assert blender.is_python
    assert blender.version.startswith("4.5.")


@pytest.mark.blender
def test_an_executable_draws_the_same(blender, workers, tmp_path):
    """A stand-in takes Blender's options and hands the script what comes after the dashes."""
    # Blender itself leaves all of its options in sys.argv; the worker takes the last word.
    path = blender_of(
        tmp_path / "blender",
        "4.5.3",
        'expected="--background --factory-startup --python-exit-code 1 --python --"\n'
        '[ "$1 $2 $3 $4 $5 $7" = "$expected" ] || exit 9\n'
        f'echo "Blender 4.5.3 (hash abc)"; exec {blender.path} "$6" "$@"',
    )
    executable = find_blender(path)
    assert (executable.is_python, executable.version) == (False, "4.5.3")
    job = one_job(scene((0, 0, 0)), vehicles(), settings=CyclesSettings(samples=1), margin_m=0.25)
    with Workers(executable, 1) as others:
        np.testing.assert_array_equal(others.run([job])[0], workers.run([job])[0])
