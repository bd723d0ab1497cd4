"""One tiny run of the demo, made once; tests that change it work on copies."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from skyproof.main import run
from tests.barely_trained import everything_counts


def flags(text: str) -> list[str]:
    """Words of a command line."""
    return text.split()


# A network that has seen eight images finds next to nothing: rates may be undefined, and nothing
# may fall over that.
SIZES = flags(
    "--sizes.image-px 128 --sizes.tiles 3 2 2 3 --sizes.vehicles 3 2 2 3 --sizes.training-images "
    "12 --sizes.validation-images 6 --sizes.test-images 6 --sizes.training-vehicles 3 "
    "--sizes.random-draws 2 --sizes.check-scenes 0"
)
STEPS = flags(
    "--training.steps 4 --training.batch-size 2 --training.validate-every 4 "
    "--training.checkpoint-every 2 --attack.steps 4 --attack.batch-size 2 "
    "--attack.checkpoint-every 2 --attack.balance-batches 1"
)
# Controls that are chosen by the detectors and not learnt.
CHOSEN = (
    *("R-U_plain", "R-U_best", "R-U_search"),
    *("R-Ma_plain", "R-PixFcMa_best", "R-PixFcMa_search"),
)
WORN = ("T-U", "T-PixFcMa", *CHOSEN, "R-U-0", "R-U-1", "R-PixFcMa-0", "R-PixFcMa-1")
TINY = [*SIZES, *STEPS, "--train", "--detectors", "retinanet", "--device", "cpu"]

# The same of detectors that come trained; they take larger networks' time, but see well.
UNTRAINED = flags(
    "--sizes.image-px 128 --sizes.tiles 1 1 2 3 --sizes.vehicles 1 1 2 3 --sizes.test-images 6 "
    "--sizes.random-draws 1 --attack.steps 2 --attack.batch-size 2 --attack.balance-batches 1 "
    "--device cpu"
)


@dataclass(frozen=True)
class Answer:
    """What a command left: exit code and both streams."""

    code: int
    out: str
    err: str

    def refused(self, *words: str) -> None:
        """Asserts the one clear sentence: exit code 2, one line, and every one of `words` in it."""
        assert self.code == 2, self.out + self.err
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("skyproof: ")
        for word in words:
            assert word in lines[0]


Skyproof = Callable[..., Answer]


@pytest.fixture
def skyproof(capfd: pytest.CaptureFixture[str]) -> Skyproof:
    """Runs the command line.

    File descriptors are captured, because libraries in C print as well.
    """

    def call(*arguments: object) -> Answer:
        capfd.readouterr()
        code = run([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return Answer(code, out, err)

    return call


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished tiny run; not to be changed."""
    folder = tmp_path_factory.mktemp("cli") / "finished"
    with everything_counts():
        assert run(["demo", "--out", str(folder), *TINY]) == 0
    return folder


@pytest.fixture(scope="session")
def worn(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run's test scenes in each of its camouflages: test-T-U, test-R-U-0, ..."""
    folder = tmp_path_factory.mktemp("worn")
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test"]
    for name in WORN:
        call = ["render", "--scenes", finished / "scenes/test.jsonl", *world, "--device", "cpu"]
        call += ["--camouflage", finished / "camouflages" / name]
        assert run(list(map(str, [*call, "--out", folder / f"test-{name}"]))) == 0
    return folder


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copies the finished run without some of its results, as if it had been stopped there."""

    def copy(*without: str) -> Path:
        folder = tmp_path / "run"
        shutil.copytree(finished, folder)
        for name in without:
            path = folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return folder

    return copy


def bytes_of(folder: Path) -> dict[str, bytes]:
    """All files below a folder, by relative path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


RESULTS = (
    "results.json",
    "detectors/retinanet/weights.safetensors",
    "camouflages/T-U/camouflage.safetensors",
    "camouflages/T-U/texture.png",
    "scores/test/outcomes.parquet",
    "datasets/test/annotations.json",
)


def assert_same_results(folder: Path, reference: Path) -> None:
    """What a stopped and resumed run leaves equals what an uninterrupted one leaves.

    No leftovers lie about.
    """
    for name in RESULTS:
        assert (folder / name).read_bytes() == (reference / name).read_bytes(), name
    assert (folder / "report.html").exists()
    assert not [path for path in folder.rglob("*") if "partial" in path.name]
