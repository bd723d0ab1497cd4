"""What a disk may hold after a power cut: a model that a test drives through `skyproof.files`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import skyproof.files

Names = dict[int, dict[str, set[int | None]]]
"""By folder, by name: the files (inodes) that the name may lead to; None: it may be missing."""


@dataclass(frozen=True)
class Cut:
    """What the disk may hold when the power goes after one event.

    Attributes:
        event: what was done last.
        data: by inode, what is surely on the disk; a file that is not here is empty.
        names: what may be found under each name.
    """

    event: str
    data: dict[int, bytes]
    names: Names

    def possible(self, folder: int) -> dict[str, list[bytes | None]]:
        """By path below a folder: every content that may be found there; None: nothing."""
        found: dict[str, list[bytes | None]] = {}
        for name, inodes in self.names.get(folder, {}).items():
            for inode in inodes:
                if inode is None:
                    found.setdefault(name, []).append(None)
                elif inode in self.names:
                    inner = self.possible(inode)
                    found.setdefault(name, []).append(b"a folder")
                    for below, contents in inner.items():
                        found.setdefault(f"{name}/{below}", []).extend(contents)
                else:
                    found.setdefault(name, []).append(self.data.get(inode, b""))
        return found


@dataclass
class Disk:
    """A disk that keeps only what was waited for.

    Data of a file are on it once the file was synced, and lost otherwise. A name is settled once
    its folder was synced; what was done to it since may have happened or not.

    Attributes:
        root: the folder that is watched.
        cuts: what is left by a power cut, after every event.
    """

    root: Path
    cuts: list[Cut] = field(default_factory=list)
    _data: dict[int, bytes] = field(default_factory=dict)
    _names: Names = field(default_factory=dict)
    # Held open, so that no number of an inode is used twice.
    _held: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._look()
        for inode, descriptor in self._held.items():
            self._sync(inode, descriptor)

    def after(self, event: str) -> None:
        """Notes what a power cut now would leave."""
        self._look()
        names = {
            folder: {name: set(inodes) for name, inodes in entries.items()}
            for folder, entries in self._names.items()
        }
        self.cuts.append(Cut(event, dict(self._data), names))

    def synced(self, descriptor: int) -> None:
        """Notes that data of a file, or names of a folder, are on the disk."""
        self._look()
        self._sync(os.fstat(descriptor).st_ino, descriptor)

    def possible(self, cut: Cut) -> dict[str, list[bytes | None]]:
        """Every content that may be found under each path after a cut."""
        return cut.possible(os.stat(self.root).st_ino)

    def close(self) -> None:
        """Lets the files go."""
        for descriptor in self._held.values():
            os.close(descriptor)
        self._held.clear()

    def _sync(self, inode: int, descriptor: int) -> None:
        if inode in self._names:
            entries = self._present(Path(f"/proc/self/fd/{descriptor}"))
            self._names[inode] = {name: {below} for name, below in entries.items()}
        else:
            self._data[inode] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def _look(self) -> None:
        for folder in [self.root, *(path for path in self.root.rglob("*") if path.is_dir())]:
            inode = self._hold(folder)
            known = self._names.setdefault(inode, {})
            present = self._present(folder)
            for name in {*known, *present}:
                known.setdefault(name, {None}).add(present.get(name))
            for name in present:
                self._hold(folder / name)

    def _hold(self, path: Path) -> int:
        inode = path.stat().st_ino
        if inode not in self._held:
            self._held[inode] = os.open(path, os.O_RDONLY)
        return inode

    @staticmethod
    def _present(folder: Path) -> dict[str, int]:
        return {path.name: path.stat().st_ino for path in folder.iterdir()}


class Watched:
    """Stands in for the module `os` in `skyproof.files`, and tells a disk of what is done."""

    WATCHED = ("open", "close", "fsync", "replace", "ftruncate", "pwrite")

    def __init__(self, disk: Disk) -> None:
        self._disk = disk

    def __getattr__(self, name: str) -> Any:
        real = getattr(os, name)
        if name not in self.WATCHED:
            return real

        def told(*arguments: Any, **options: Any) -> Any:
            self._disk.after(f"before {name} {arguments}")
            result = real(*arguments, **options)
            if name == "fsync":
                self._disk.synced(arguments[0])
            self._disk.after(f"{name} {arguments}")
            return result

        return told


@contextmanager
def watched(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    """Watches everything that `skyproof.files` does while the block runs."""
    disk = Disk(root)
    with monkeypatch.context() as patch:
        patch.setattr(skyproof.files, "os", Watched(disk))
        yield disk
    disk.after("the end")
    disk.close()


def torn(
    disk: Disk, old: dict[str, bytes], new: dict[str, bytes], together: tuple[str, ...]
) -> list[str]:
    """What no power cut may leave: finished names with less than all, older files lost.

    Args:
        disk: after everything was done.
        old: what was there before, by path.
        new: what is there in the end, by path; without old content it may be missing after a cut.
        together: finished folders; one that may be there must have all its files.

    Returns:
        What was found wrong, in words; empty where a power cut harms nothing.
    """
    wrong = []
    for cut in disk.cuts:
        found = disk.possible(cut)
        there = [folder for folder in together if b"a folder" in found.get(folder, [])]
        for path in sorted({*old, *new}):
            whole = {old.get(path), new.get(path)} - {None}
            expected = path in old or path.partition("/")[0] in there
            for content in found.get(path, [None]):
                if content is None and expected:
                    wrong.append(f"{path} may be missing after {cut.event}")
                elif content is not None and content not in whole:
                    wrong.append(f"{path} may hold {content[:20]!r} after {cut.event}")
    return wrong
