"""Writing so that a kill or a full disk never leaves a half-written file under its final name."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skyproof.errors import RunFolderError, StoredFileError

__all__ = [
    "finished_folder",
    "is_leftover",
    "read_json",
    "read_jsonl",
    "refuse_existing",
    "refuse_foreign",
    "write_beside",
    "write_bytes",
    "write_json",
    "write_jsonl",
]

_NEARLY_FULL_BYTES = 2**20


@contextmanager
def write_beside(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, which becomes `path` when the block ends well.

    When the block ends otherwise, what lies at the temporary path is removed.

    Raises:
        RunFolderError: the disk is full or not writable; names `path` and the remedy.
    """
    path = Path(path)
    # The suffix is kept last, because libraries choose a format by it.
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        if temporary.exists():
            temporary.unlink()


@contextmanager
def finished_folder(path: Path) -> Iterator[Path]:
    """Yields a fresh folder `.<name>.partial`, which becomes `path` when the block ends well.

    Only a folder under its final name counts as finished. When the block ends otherwise what it
    wrote is removed, so that a full disk has room again; what a kill left is thrown away by the
    next try.

    Raises:
        RunFolderError: `path` exists already, or the disk is full or not writable.
    """
    path = Path(path)
    refuse_existing(path)
    # Hidden, so that a folder of the user's is not mistaken for a leftover of ours.
    partial = path.with_name(f".{path.name}.partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def is_leftover(path: Path) -> bool:
    """Whether a kill left this file or folder.

    It was being written then, and never got its final name.
    """
    return path.name.startswith(".") and (
        path.name.endswith(".partial") or path.stem.endswith(".partial")
    )


def refuse_existing(path: Path) -> None:
    """Keeps a stage from overwriting what is there.

    Raises:
        RunFolderError: `path` exists.
    """
    if path.exists():
        raise RunFolderError(
            f"{path} exists already and is not overwritten; choose another --out or remove it "
            "first."
        )


def refuse_foreign(folder: Path, ours: Collection[str]) -> None:
    """Keeps a stage from writing among files that are not its own.

    Args:
        folder: where it is about to write; may be missing.
        ours: names that the stage itself may have left there.

    Raises:
        RunFolderError: the folder is a file, or holds something else.
    """
    folder = Path(folder)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise RunFolderError(f"{folder} is a file; choose another --out.")
    foreign = sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.name not in ours and not is_leftover(entry)
    )
    if foreign:
        raise RunFolderError(
            f"{folder} holds files that are not of this stage ({foreign[0]}); choose another --out."
        )


def _unwritable(path: Path, error: OSError) -> RunFolderError:
    reason = error.strerror or " ".join(str(error).split())
    if error.errno is None and _is_full(path):
        # Image encoders report a failed write without its cause.
        reason = os.strerror(errno.ENOSPC)
    return RunFolderError(
        f"Could not write {path}: {reason}; free space or choose another --out, then run the same "
        "command again (finished stages are kept)."
    )


def _is_full(path: Path) -> bool:
    try:
        return shutil.disk_usage(path.parent).free < _NEARLY_FULL_BYTES
    except OSError:
        return False


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` whole or not at all."""
    with write_beside(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON, whole or not at all."""
    write_bytes(path, (json.dumps(value, indent=1, ensure_ascii=False) + "\n").encode())


def write_jsonl(path: Path, rows: Iterable[Any]) -> None:
    """Writes one JSON value a line, whole or not at all."""
    write_bytes(path, "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows).encode())


def read_json(path: Path, *, leave_out: str | None = None) -> Any:
    """Reads JSON.

    Args:
        path: the file.
        leave_out: a field that no object keeps; a large one is given up while the file is read.

    Raises:
        StoredFileError: the file is missing or not JSON; names it.
    """

    def thinned(mapping: dict[str, Any]) -> dict[str, Any]:
        mapping.pop(str(leave_out), None)
        return mapping

    hook = None if leave_out is None else thinned
    return _read(path, lambda text: json.loads(text, object_hook=hook))


def read_jsonl(path: Path) -> list[Any]:
    """Reads one JSON value a line.

    Raises:
        StoredFileError: the file is missing or a line is not JSON; names it.
    """
    return _read(path, lambda text: [json.loads(line) for line in text.splitlines() if line])


def _read(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StoredFileError(
            f"{path} is missing; run the stage that writes it, or give another folder."
        ) from error
    except (ValueError, OSError) as error:
        raise StoredFileError(
            f"{path} cannot be read ({error}); remove it and run its stage again."
        ) from error
