"""A power cut after any event leaves every finished name whole, and every older file as it was."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save

import skyproof.files
from skyproof.files import (
    finished_folder,
    is_leftover,
    new_file,
    write_beside,
    write_bytes,
    write_json,
    write_jsonl,
)
from skyproof.main import run
from skyproof.storage import write_tensors
from tests.power_cut import torn, watched


def contents(root: Path) -> dict[str, bytes]:
    """All finished files by path."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file() and not any(map(is_leftover, [path, *path.parents]))
    }


def json_twice(root: Path) -> None:
    write_json(root / "a.json", {"version": 1})
    write_json(root / "a.json", {"version": 2})


def rows(root: Path) -> None:
    write_jsonl(root / "steps.jsonl", [{"step": step} for step in range(1000)])


def tensors(root: Path) -> None:
    write_tensors(root / "state.safetensors", {"w": torch.ones(1000)}, {"step": 3})


def picture(root: Path) -> None:
    path = root / "portrait.png"
    with new_file(path), write_beside(path) as temporary:
        Image.new("RGB", (30, 30)).save(temporary)


def folder_by_libraries(root: Path) -> None:
    with finished_folder(root / "tiles") as partial:
        (partial / "images").mkdir()
        Image.new("RGB", (30, 30)).save(partial / "images" / "a.png")
        np.save(partial / "images" / "b.npy", np.ones(100))
        write_json(partial / "index.json", {"tiles": ["a", "b"]})
        (partial / "notes.txt").write_text("written by hand")


def folder_after_a_kill(root: Path) -> None:
    (root / ".tiles.partial").mkdir()
    (root / ".tiles.partial" / "old.png").write_bytes(b"left")
    folder_by_libraries(root)


def stop(path: Path) -> None:
    path.write_bytes(b"half")
    raise KeyError


def failed_in_between(root: Path) -> None:
    with suppress(KeyError), finished_folder(root / "tiles") as partial:
        stop(partial / "a")
    with suppress(KeyError), write_beside(root / "a.json") as temporary:
        stop(temporary)
    write_bytes(root / "a.json", b"whole")


def fleets(root: Path) -> None:
    assert run(["vehicles", "--out", str(root / "fleets"), "--counts", "1", "1", "1", "1"]) == 0


def camouflage(root: Path) -> None:
    command = ["attack", "R-S-O@0.4", "--out", str(root / "camouflages"), "--device", "cpu"]
    assert run(command) == 0


WRITERS = [json_twice, rows, tensors, picture, folder_by_libraries, folder_after_a_kill]
WRITERS += [failed_in_between, fleets, camouflage]


def left_torn(
    writer: Callable[[Path], None], root: Path, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """What a power cut during a writer may leave that is not whole."""
    root.mkdir()
    old = {"a.json": b'{"version": 0}', "mine/holiday.jpg": b"precious"}
    old["state.safetensors"] = save({"w": torch.zeros(3)})
    for path, content in old.items():
        (root / path).parent.mkdir(exist_ok=True)
        (root / path).write_bytes(content)
    with watched(root, monkeypatch) as disk:
        writer(root)
    new = contents(root)
    assert disk.cuts
    # Of two versions written one after the other, the first is whole, too.
    versions = {"a.json": (json.dumps({"version": 1}, indent=1) + "\n").encode()}
    return [
        words
        for words in torn(disk, old, new, ("tiles", "fleets"))
        if not (writer is json_twice and repr(versions["a.json"][:20]) in words)
    ]


@pytest.mark.parametrize("writer", WRITERS)
def test_nothing_finished_is_torn(
    writer: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert left_torn(writer, tmp_path / "disk", monkeypatch) == []


@pytest.mark.parametrize("writer", WRITERS)
def test_without_waiting_for_the_disk_it_would_be(
    writer: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skyproof.files, "_settle", lambda path: None)
    assert left_torn(writer, tmp_path / "disk", monkeypatch) != []


def test_files_alone_are_not_enough_for_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle = skyproof.files._settle
    monkeypatch.setattr(
        skyproof.files, "_settle", lambda path: None if path.is_dir() else settle(path)
    )
    wrong = left_torn(folder_by_libraries, tmp_path / "disk", monkeypatch)
    assert any("tiles/images/a.png may be missing" in words for words in wrong)


def test_what_is_written_first_is_there_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that says that another is finished cannot outlive it."""
    with watched(tmp_path, monkeypatch) as disk:
        write_bytes(tmp_path / "weights", b"w" * 10_000)
        write_json(tmp_path / "card.json", {"weights": "weights"})
    for cut in disk.cuts:
        found = disk.possible(cut)
        if any(content is not None for content in found.get("card.json", [None])):
            assert found["weights"] == [b"w" * 10_000]


def test_an_overwrite_in_place_would_be_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model itself can fail: a plain copy over an older file is not whole at all times."""

    def copied(root: Path) -> None:
        (root / "b").write_bytes(b"new")
        shutil.copy(root / "b", root / "c")
        write_bytes(root / "d", b"")

    assert any(
        "c may hold b''" in words for words in left_torn(copied, tmp_path / "x", monkeypatch)
    )
