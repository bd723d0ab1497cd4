"""One tiny run, made once; tests that change it work on copies."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from skyproof.main import run
from tests.tiny_suite import draw_datasets, tiny_suite


def flags(text: str) -> list[str]:
    """Words of a command line."""
    return text.split()


# Controls that are chosen by the detectors and not learnt.
CHOSEN = (
    *("R-U_plain", "R-U_best", "R-U_search", "R-U_pattern"),
    *("R-Ma_plain", "R-PixFcMa_best", "R-PixFcMa_search", "R-Ma_pattern"),
)
WORN = ("T-U", "T-PixFcMa", *CHOSEN, "R-U-0", "R-U-1", "R-PixFcMa-0", "R-PixFcMa-1")
TINY = ["assess", "retinanet", "--device", "cpu"]
"""A run that is tiny by its suite, but for its folder."""


@pytest.fixture(scope="session", autouse=True)
def suites() -> Iterator[None]:
    """Whole runs go by a suite that is far too small."""
    with tiny_suite():
        yield


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
def finished(suites: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished tiny run; not to be changed."""
    folder = tmp_path_factory.mktemp("cli") / "finished"
    assert run([*TINY, "--out", str(folder)]) == 0
    draw_datasets(folder, 128, train=12, validation=6)
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
    "scores/test-0/outcomes.parquet",
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
