"""A disk that fills up in the middle of any stage."""

import errno
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest
from PIL import Image

from tests.cli.conftest import TINY, Skyproof, assert_same_results

pytestmark = pytest.mark.slow

# What is written, which write of it fails, and the file or folder whose presence means that the
# stage is finished.
CASES = {
    "tile": ("tiles/", 3, "backgrounds"),
    "tile index": ("index.json", 1, "backgrounds"),
    "detector weights": ("retinanet/weights.safetensors", 1, "detectors/retinanet/detector.json"),
    "detector card": ("retinanet/detector.json", 1, "detectors/retinanet/detector.json"),
    "fleet": ("fleets/train/fleet.safetensors", 1, "fleets"),
    "fleet description": ("fleets/test/fleet.json", 1, "fleets"),
    "scenes": ("scenes/test.jsonl", 1, "scenes/test.jsonl"),
    "dataset labels": ("datasets/test/annotations.json", 1, "datasets/test"),
    "dataset image": ("datasets/test/images/", 2, "datasets/test"),
    "attack mark": ("T-U/checkpoint.safetensors", 1, "camouflages/T-U/camouflage.json"),
    "attack checkpoint": ("T-U/checkpoint.safetensors", 2, "camouflages/T-U/camouflage.json"),
    "attack preview": ("T-U/previews/", 2, "camouflages/T-U/camouflage.json"),
    "camouflage": ("T-U/camouflage.safetensors", 1, "camouflages/T-U/camouflage.json"),
    "camouflage picture": ("T-U/texture.png", 1, "camouflages/T-U/camouflage.json"),
    "camouflage record": ("T-U/camouflage.json", 1, "camouflages/T-U/camouflage.json"),
    "control": ("R-U-1/texture.png", 1, "camouflages/R-U-1/camouflage.json"),
    "outcomes": ("outcomes.parquet", 1, "scores/test-0"),
    "score record": ("scores/test-0/score.json", 1, "scores/test-0"),
    "pair picture": ("pairs/T-U/", 1, "scores/test-0"),
    "portrait": ("on_vehicle.png", 1, "scores/test-0"),
    "results": ("results.json", 1, "results.json"),
    "report": ("report.html", 1, "report.html"),
}


class FullDisk:
    """Lets the n-th write to a path with `fragment` end half-way with ENOSPC."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fragment: str, nth: int) -> None:
        self.fragment, self.left = fragment, nth
        for owner, name, place in (
            (Path, "write_bytes", 0),
            (Image.Image, "save", 1),
            (pyarrow.parquet, "write_table", 1),
        ):
            self._wrap(monkeypatch, owner, name, place)

    def _wrap(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, place: int) -> None:
        genuine = getattr(owner, name)

        def write(*arguments: Any, **options: Any) -> Any:
            target = arguments[place]
            if isinstance(target, str | Path) and self._hits(Path(target)):
                with open(target, "wb") as file:
                    file.write(b"half")
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
            return genuine(*arguments, **options)

        monkeypatch.setattr(owner, name, write)

    def _hits(self, path: Path) -> bool:
        # What is being written has a leading dot and "partial" in its name.
        if self.fragment not in str(path).replace(".partial", "").replace("/.", "/"):
            return False
        self.left -= 1
        return self.left == 0


def test_full_disk_in_every_stage(tmp_path: Path, finished: Path, skyproof: Skyproof) -> None:
    """One run is stopped by a full disk at every kind of file that it writes.

    Each time it goes on from there.
    """
    folder = tmp_path / "run"
    for case, (fragment, nth, result) in CASES.items():
        with pytest.MonkeyPatch.context() as monkeypatch:
            disk = FullDisk(monkeypatch, fragment, nth)
            answer = skyproof(*TINY, "--out", folder)
        assert disk.left == 0, case
        answer.refused("No space left on device", "free space", str(folder))
        # Only what bears this name counts as finished.
        assert not (folder / result).exists(), case
        assert not [path for path in folder.rglob("*") if "partial" in path.name], case
    assert skyproof(*TINY, "--out", folder).code == 0
    assert_same_results(folder, finished)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB in memory."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = shutil.which("mount")
    if (
        not mount
        or subprocess.run([mount, "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(place)]).returncode
    ):
        pytest.skip("mounting a tmpfs needs root and the right to mount")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def test_really_full_disk(small_disk: Path, finished: Path, skyproof: Skyproof) -> None:
    """Room is given a little at a time.

    The run stops at many places and goes on at each of them.
    """
    filler, stops = small_disk / "filler", 0
    while True:
        room = 2**20 * (1 + 6 * stops)
        free = shutil.disk_usage(small_disk).free + (
            filler.stat().st_size if filler.exists() else 0
        )
        used = 64 * 2**20 - free
        filler.write_bytes(b"x" * max(0, 64 * 2**20 - used - max(0, room - used)))
        answer = skyproof(*TINY, "--out", small_disk / "run")
        if answer.code == 0:
            break
        answer.refused("No space left on device", "free space", str(small_disk / "run"))
        stops += 1
        assert stops < 30
    assert stops >= 4
    assert_same_results(small_disk / "run", finished)
