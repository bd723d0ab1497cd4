"""Writes so that a kill or a full disk never leaves a partial file under its final name."""

import errno
import hashlib
import json
import os
import shutil
import stat
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from filelock import FileLock, Timeout

from skyproof.errors import NotFiniteError, RunFolderError, SkyproofError, StoredFileError

_NEARLY_FULL_BYTES = 2**20


@contextmanager
def write_beside(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, which becomes `path` if the block ends well.

    The file is on the disk before it gets its name, so that not even a power cut leaves an empty
    one. A disk that is full or cannot be written is a RunFolderError with the remedy.
    """
    path = Path(path)
    # The suffix is kept last, because libraries choose a format by it.
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Removes the leftover of a kill, or a link, which the block would write through.
        temporary.unlink(missing_ok=True)
        yield temporary
        _settle(temporary)
        os.replace(temporary, path)
        _settle(path.parent)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        if temporary.is_file() or temporary.is_symlink():
            temporary.unlink()


@contextmanager
def new_file(path: Path) -> Iterator[None]:
    """Locks a file that must not exist yet, while the block writes it with `write_beside`."""
    with alone(path):
        refuse_existing(path)
        yield


@contextmanager
def finished_folder(path: Path) -> Iterator[Path]:
    """Yields a fresh folder `.<name>.partial`, which becomes `path` if the block ends well.

    By then all of it is on the disk. If the block fails, its files are removed, so that a full disk
    has room again; the next try removes the leftovers of a kill.
    """
    path = _place(path)
    # The name is hidden, so that it cannot be a folder of the user.
    partial = path.with_name(f".{path.name}.partial")
    with alone(path):
        refuse_existing(path)
        try:
            if partial.exists():
                shutil.rmtree(partial)
            partial.mkdir(parents=True)
            yield partial
            for entry in partial.rglob("*"):
                _settle(entry)
            _settle(partial)
            os.replace(partial, path)
            _settle(path.parent)
        except OSError as error:
            raise _unwritable(path, error) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def alone(place: Path) -> "Iterator[Hold]":
    """Locks a file or folder against other writers, in this process too.

    The lock is a file `.<name>.lock` beside the place; it names its holder. The holder's death
    releases it, and a leftover lock file is no obstacle.
    """
    place = _place(place).resolve()
    path = place.with_name(f".{place.name}.lock")
    descriptors: list[int] = []
    lock = FileLock(path, blocking=False, thread_local=False, on_acquired=descriptors.append)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Taking the lock empties its file, which a second name would lose.
        if os.path.lexists(path) and (path.is_symlink() or path.stat().st_nlink > 1):
            raise RunFolderError(f"{path} is a link to another file; remove the link.")
        lock.acquire()
    except Timeout:
        raise RunFolderError(
            f"{place} is being written by another process ({_holder(path)}); wait for it, or "
            "choose another --out."
        ) from None
    except OSError as error:
        raise _unwritable(place, error) from error
    try:
        hold = Hold(descriptors[-1])
        hold.note(f"process {os.getpid()}, {' '.join(['skyproof', *sys.argv[1:]])[:200]}")
        yield hold
    finally:
        # Removed while it is held: afterwards it might belong to another process.
        with suppress(OSError):
            path.unlink()
        lock.release()


@dataclass(frozen=True)
class Hold:
    """A lock in use; a child process that inherits its file's descriptor holds it, too."""

    descriptor: int

    def note(self, text: str) -> None:
        """Writes the lock's holder, for others to read."""
        with suppress(OSError):
            os.ftruncate(self.descriptor, 0)
            os.pwrite(self.descriptor, text.encode(errors="replace"), 0)


def _place(path: Path) -> Path:
    """Refuses a place without a name, such as "/", or one that no system can have."""
    path = Path(path)
    try:
        path = path if path.name else path.resolve()
        named = bool(path.resolve().name)
    except (OSError, RuntimeError, ValueError):
        # The name holds a NUL, or a link leads to itself.
        named = False
    if not named:
        raise RunFolderError(f"{str(path)!r} is no place for a result; choose another --out.")
    return path


def _holder(lock: Path) -> str:
    with suppress(OSError):
        return lock.read_text(encoding="utf-8", errors="replace")[:300] or "it has just started"
    return "it does not say which"


def _settle(path: Path) -> None:
    """Waits until a file, or a folder's list of names, is on the disk."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        # Some systems do not open folders; if a library failed to write the file, it shows later.
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems do not support waiting.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES):
            raise
    finally:
        os.close(descriptor)


def is_leftover(path: Path) -> bool:
    """Whether a kill left this file or folder: a partial one, or the lock of its writer."""
    return path.name.startswith(".") and (
        path.name.endswith((".partial", ".lock")) or path.stem.endswith(".partial")
    )


def drop_empty_folder(path: Path) -> None:
    """Removes a folder if it is empty: Snakemake makes that of a step's result in advance."""
    with suppress(OSError):
        path.rmdir()


def refuse_unwritable(place: Path) -> None:
    """Refuses a place in which this process cannot make a file or folder; writes nothing."""
    place = _place(place).resolve()
    above = next(folder for folder in place.parents if os.path.lexists(folder))
    code = errno.EACCES if above.is_dir() else errno.ENOTDIR
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise _unwritable(place, OSError(code, os.strerror(code), str(above)))


def refuse_existing(path: Path) -> None:
    """Keeps a stage from overwriting an existing path."""
    # A broken link belongs to the user, too.
    if os.path.lexists(path):
        raise RunFolderError(
            f"{path} exists already and is not overwritten; choose another --out, or move it away "
            "first."
        )


def refuse_foreign(folder: Path, ours: Collection[str]) -> None:
    """Keeps a stage from writing among foreign files; `ours` names the files it may have left."""
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
        raise RunFolderError(f"{folder} holds something else ({foreign[0]}); choose another --out.")


def refuse_links(folder: Path) -> None:
    """Keeps a command from writing through links to folders elsewhere, in a folder that exists.

    The folder itself may be a link: its user chose it.
    """
    root = Path(folder).resolve()
    for place, folders, _ in os.walk(folder):
        for name in folders:
            path = Path(place) / name
            # Links to files are replaced, not written through.
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise RunFolderError(
                    f"{path} is a link to a folder elsewhere, where results would overwrite files; "
                    "put the folder itself there, or choose another --out."
                )


def refuse_special(
    path: Path,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
    largest_bytes: int | None = None,
) -> None:
    """Keeps a reader from devices, pipes and sockets, which may never end, and from large files."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        # Its reader says what is wrong.
        return
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise error(f"{path} is a device, pipe or socket, not a file; {remedy}.")
    if largest_bytes is not None and status.st_size > largest_bytes:
        raise error(
            f"{path} has {status.st_size / 2**20:,.0f} MiB, more than the "
            f"{largest_bytes / 2**20:,.0f} MiB that are read at once; {remedy}."
        )


def file_digest(path: Path) -> str:
    """Computes the SHA-256 of a file of any size."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def value_digest(value: Any) -> str:
    """Computes the SHA-256 of plain values, dataclasses and Structs, by their JSON text."""
    return hashlib.sha256(msgspec.json.encode(value)).hexdigest()


def inside(folder: Path, reference: str, document: Path) -> Path:
    """Returns the file below `folder` that a document in it names; no link may lead out of it."""
    path = Path(folder) / reference
    try:
        leads_out = not path.resolve().is_relative_to(Path(folder).resolve())
    except (OSError, RuntimeError, ValueError):
        # The link leads to itself, or the name is not valid.
        leads_out = True
    if leads_out:
        raise StoredFileError(
            f"{document} names {reference}, which leads out of its folder; put the file itself "
            "there."
        )
    return path


def _unwritable(path: Path, error: OSError) -> RunFolderError:
    reason = error.strerror or " ".join(str(error).split())
    if error.errno is None and _is_full(path):
        # Image encoders report a failed write without its cause.
        reason = os.strerror(errno.ENOSPC)
    remedy = "choose another --out, or make this place writable"
    if reason in map(os.strerror, (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)):
        remedy = "free space or choose another --out, then run the same command again (what is "
        remedy += "finished is kept)"
    return RunFolderError(f"Could not write {path}: {reason}; {remedy}.")


def _is_full(path: Path) -> bool:
    with suppress(OSError):
        return shutil.disk_usage(path.parent).free < _NEARLY_FULL_BYTES
    return False


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` whole or not at all."""
    with write_beside(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON, whole or not at all; refuses numbers that are not finite."""
    write_bytes(path, (to_json(path, value, indent=1) + "\n").encode())


def write_jsonl(path: Path, rows: Iterable[Any]) -> None:
    """Writes one JSON value a line, whole or not at all; refuses numbers that are not finite."""
    write_bytes(path, "".join(to_json(path, row) + "\n" for row in rows).encode())


def to_json(path: Path, value: Any, indent: int | None = None) -> str:
    """Returns a value as JSON text; the error about a number that is not finite names `path`."""
    try:
        return json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError as error:
        raise NotFiniteError(
            f"{path} would hold a number that is not finite and was not written; lower the "
            "learning rate, or look for the input that is out of range."
        ) from error
