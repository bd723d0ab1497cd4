"""A place where commands meet hostile files, and where everything that they touch is seen."""

from __future__ import annotations

import io
import json
import os
import shutil
import stat
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin
from safetensors.numpy import load_file

from skyproof.generator.__main__ import COMMANDS as LEARNING
from skyproof.main import COMMANDS, run
from tests.hostile.values import finite
from tests.hostile.world import one_texture

MARK = b"the user's own and nobody else's 5b1c9"

RAN: Counter[str] = Counter()
"""How many examples were run, by kind of document."""


@dataclass(frozen=True)
class Kind:
    """A kind of document, and the cheapest command that reads it.

    Attributes:
        name: for the count and for failures.
        document: the file, below the folder of inputs.
        words: the command for the folder of inputs and an output folder.
        copied: a folder of the inputs that the command changes in place; it works on a copy in the
            output folder, which is the second argument of `words`.
        lines: the document has one JSON value a line.
        slow: the command takes half a second or more; fewer examples are tried.
        called: what a sentence may call the document, beside its file name.
    """

    name: str
    document: str
    words: Callable[[Path, Path], Sequence[object]]
    copied: str | None = None
    lines: bool = False
    slow: bool = False
    called: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.name


@dataclass
class Sandbox:
    """Inputs, an output folder, and files of the user's all around.

    Attributes:
        root: everything below it is watched.
        inputs: valid documents and what belongs to them.
        out: what commands may write to; empty before each.
    """

    root: Path
    inputs: Path = field(init=False)
    out: Path = field(init=False)

    def __post_init__(self) -> None:
        self.inputs = self.root / "a" / "b" / "c" / "inputs"
        self.out = self.root / "a" / "b" / "c" / "out"
        for folder in ("victim", "a/b/c", "a/b/c/x", "a/b/x", "a/x", "x"):
            place = self.root / folder
            place.mkdir(parents=True, exist_ok=True)
            canary(place / "holiday.png")
            (place / "letter.txt").write_bytes(MARK)
        (self.root / "a" / "b" / "c" / "here").mkdir()

    @property
    def victim(self) -> Path:
        """A picture of the user's, which no document may name."""
        return self.root / "victim" / "holiday.png"

    def try_document(self, kind: Kind, content: bytes) -> int:
        """Runs a kind's command on a document, and checks all that is promised of it.

        Returns:
            The exit code: 0, or 2 with one sentence.
        """
        document = self.inputs / kind.document
        good = document.read_bytes()
        self.clear()
        try:
            if kind.copied is None:
                document.write_bytes(content)
            else:
                linked(self.inputs / kind.copied, self.out / "copy")
                document = self.out / "copy" / Path(kind.document).relative_to(kind.copied)
                document.unlink()
                document.write_bytes(content)
            answer = self.call(kind.words(self.inputs, self.out), content)
        finally:
            if kind.copied is None:
                document.write_bytes(good)
        RAN[kind.name] += 1
        if answer.code == 2:
            answer.assert_one_sentence()
            named = (*kind.called, document.name, str(document.parent), str(self.inputs))
            assert any(name in answer.err for name in named), answer.err
        else:
            assert answer.code == 0, answer
        return answer.code

    def clear(self) -> None:
        """Empties the output folder."""
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir()

    def call(self, words: Sequence[object], given: bytes = b"") -> Answer:
        """Runs a command; whatever is not below `out` must stay as it is.

        Args:
            words: of the command line.
            given: the hostile document itself, which may stay in the output folder.
        """
        before = self._seen()
        answer = called([str(word) for word in words], self.root / "a" / "b" / "c" / "here")
        assert self._seen() == before, (answer, "something outside --out was touched")
        self._assert_clean(answer, given)
        return answer

    def _seen(self) -> dict[str, tuple[int, int, int]]:
        """Everything below the root but the output folder: size, time of change, mode."""
        return {
            # Folders change their times when a lock comes and goes.
            path: (0, 0, status.st_mode)
            if stat.S_ISDIR(status.st_mode)
            else (status.st_size, status.st_mtime_ns, status.st_mode)
            for path, status in entries(self.root, str(self.out))
        }

    def _assert_clean(self, answer: Answer, given: bytes) -> None:
        """Asserts that what was written is finite, whole, and holds nothing of the user's."""
        for path, status in entries(self.out):
            assert ".partial" not in path, (answer, path)
            assert not path.endswith(".lock"), (answer, path)
            if os.path.isdir(path) or status.st_nlink > 1:
                continue
            content = Path(path).read_bytes()
            assert MARK not in content, (answer, path)
            if answer.code != 0 or content == given:
                continue
            if path.endswith((".json", ".geojson")):
                assert finite(json.loads(content)), (answer, path)
            elif path.endswith(".jsonl"):
                assert all(map(finite, map(json.loads, content.splitlines()))), (answer, path)
            elif path.endswith(".safetensors"):
                assert all(np.isfinite(part).all() for part in load_file(path).values()), path


@dataclass(frozen=True)
class Answer:
    """What a command left: exit code, both streams, warnings of libraries."""

    words: Sequence[str]
    code: int
    out: str
    err: str
    warned: Sequence[str]

    def assert_one_sentence(self) -> None:
        """Asserts one line on standard error, and nothing of a library's."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self
        assert lines[0].startswith("skyproof: "), self
        assert lines[0].endswith((".", "?")), self
        assert len(lines[0]) < 1500, self
        assert lines[0].isprintable(), self
        for word in ("Traceback", "Error(", "errno", "weights_only", "torch.load"):
            assert word not in lines[0], self
        assert not self.warned, self


def canary(path: Path) -> None:
    """A picture that can be told from every other."""
    info = PngImagePlugin.PngInfo()
    info.add_text("mark", MARK.decode())
    Image.new("RGB", (64, 64), (200, 30, 90)).save(path, pnginfo=info)


def entries(root: Path, *without: str) -> Iterator[tuple[str, os.stat_result]]:
    """Everything below a folder, links as links."""
    waiting = [str(root)]
    while waiting:
        with os.scandir(waiting.pop()) as found:
            for entry in found:
                if entry.path in without:
                    continue
                yield entry.path, entry.stat(follow_symlinks=False)
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)


def linked(folder: Path, copy: Path) -> None:
    """Copies a folder without copying its files: an overwrite in place shows in the original."""
    shutil.copytree(folder, copy, copy_function=os.link)


def called(words: list[str], folder: Path) -> Answer:
    """Runs a command line in this process, in a folder of its own, and catches all that it says."""
    here = os.getcwd()
    os.chdir(folder)
    try:
        with warnings.catch_warnings(record=True) as warned, _streams() as said:
            warnings.simplefilter("always")
            for silent in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
                warnings.simplefilter("ignore", silent)
            with one_texture():
                code = run(words, commands={**COMMANDS, **LEARNING})
    finally:
        os.chdir(here)
    messages = [f"{warning.category.__name__}: {warning.message}" for warning in warned]
    return Answer([word[:200] for word in words], code, *said(), messages)


@contextmanager
def _streams() -> Iterator[Callable[[], tuple[str, str]]]:
    """Catches both streams; libraries in C write to the descriptors."""
    texts = (io.StringIO(), io.StringIO())
    kept = (sys.stdout, sys.stderr, os.dup(1), os.dup(2))
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        caught: list[str] = []
        sys.stdout, sys.stderr = texts
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        try:
            yield lambda: (caught[0], caught[1])
        finally:
            sys.stdout, sys.stderr = kept[0], kept[1]
            for number, descriptor in ((1, kept[2]), (2, kept[3])):
                os.dup2(descriptor, number)
                os.close(descriptor)
            for text, file in zip(texts, (out, err), strict=True):
                file.seek(0)
                caught.append(text.getvalue() + file.read().decode(errors="replace"))
