"""The wheel: built from the repository and installed elsewhere, it holds all that a run needs."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import skyproof

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src"
FEW_SCENES = ROOT / "tests" / "few_scenes.py"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built as an installer builds it, by the build backend that is installed here."""
    pytest.importorskip("hatchling", reason="needs the extra `test`, with hatchling in it")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True, timeout=120)
    [built] = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel in it; the dependencies are those of this one, by reference."""
    folder = tmp_path_factory.mktemp("empty") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install"]
    subprocess.run([*pip, "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    [packages] = folder.glob("lib/python*/site-packages")
    # A path file is not read in the folders that it names, so the editable checkout stays out.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder


def call(environment: Path, program: str, *arguments: object) -> str:
    """What a program of that environment prints; it sees nothing of the checkout."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(environment / "bin" / program), *map(str, arguments)],
        cwd=environment,
        env={**kept, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if name.startswith("skyproof/")}
    files = {
        path.relative_to(SOURCE).as_posix()
        for path in (SOURCE / "skyproof").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert inside == files
    assert inside >= {
        "skyproof/py.typed",
        "skyproof/reproduction/Snakefile",
        "skyproof/reproduction/overnight.json",
        "skyproof/reproduction/quick.json",
        "skyproof/reproduction/paper.json",
        "skyproof/detectors/reference/README.md",
        "skyproof/detectors/reference/retinanet/precheck.json",
        "skyproof/detectors/reference/retinanet/detector.json",
        "skyproof/detectors/reference/retinanet/weights.safetensors",
        "skyproof/detectors/reference/faster_rcnn/weights.safetensors",
        "skyproof/reproduction/reference.json",
        "skyproof/report/report.html.j2",
        "skyproof/cycles/worker.py",
    }


def test_the_source_distribution_holds_the_reference_detectors(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="needs the extra `test`, with hatchling in it")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, timeout=120, capture_output=True)
    [built] = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    place = SOURCE / "skyproof" / "detectors" / "reference"
    files = {path.relative_to(ROOT).as_posix() for path in place.rglob("*") if path.is_file()}
    assert len(files) == 15
    assert inside >= {*files, "LICENSE"}


def test_the_version_is_told_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "version" not in project
    assert project["dynamic"] == ["version"]
    assert f"version: {skyproof.__version__}" in (ROOT / "CITATION.cff").read_text()
    assert f"## [{skyproof.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.slow
def test_an_installed_wheel_runs_the_demo_and_plans_a_reproduction(environment: Path) -> None:
    where = call(environment, "python", "-c", "import skyproof; print(skyproof.__file__)")
    assert Path(where.strip()).is_relative_to(environment)
    asked = "from importlib.metadata import version; print(version('skyproof'))"
    assert call(environment, "python", "-c", asked).strip() == skyproof.__version__
    # By a suite that is far too small; what chooses controls is there, and not tried on many.
    shutil.copy(FEW_SCENES, environment)
    short = """
from few_scenes import few_scenes_judge
from dataclasses import replace
from skyproof.assessment import assess, suite
from skyproof.main import run

whole = suite.read_suite(suite.DEMO_SUITE)
tiny = replace(
    whole, attacks=("T-U",), steps=replace(whole.steps, texture=1), draws=1, best_of=2, searches=1,
    settings=replace(whole.settings, batch_size=2, balance_batches=1), image_m=16.0, test_images=6,
    empty_images=6, tiles=(1, 1, 2, 3), vehicles=(1, 1, 2, 3),
)
assess.read_suite = lambda path: tiny
with few_scenes_judge():
    raise SystemExit(run(["demo", "--out", "demo", "--device", "cpu"]))
"""
    call(environment, "python", "-c", short)
    assert (environment / "demo" / "report.html").read_text().rstrip().endswith("</html>")
    assert (environment / "demo" / "results.json").exists()
    plan = ["reproduce", "--preset", "quick", "--out", "quick", "--dry-run"]
    assert " 307 steps " in call(environment, "skyproof", *plan)
