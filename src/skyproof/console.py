"""What the command line prints: stages, progress with time left, one sentence for an error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

# Without a terminal (a log file, CI) a line now and then replaces the moving bar.
_LINE_EVERY_S = 15.0


def say(message: str) -> None:
    """Prints one line."""
    _print(message, sys.stdout)


def say_error(message: str) -> None:
    """Prints one line to standard error."""
    # Messages of libraries may hold line breaks, names in files what moves a terminal's cursor.
    line = "".join(sign if sign.isprintable() else "?" for sign in " ".join(message.split()))
    _print(f"skyproof: {line}", sys.stderr)


def _print(line: str, stream: Any) -> None:
    try:
        print(line, file=stream, flush=True)
    except UnicodeEncodeError:
        # A terminal without these letters, or the name of a file that is no text.
        encoding = stream.encoding or "ascii"
        shown = line.encode(encoding, "backslashreplace").decode(encoding)
        print(shown, file=stream, flush=True)


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """Yields `update(done, total)`; shows name, progress, time used and time left."""
    if sys.stdout.isatty():
        with _moving_bar(name) as moving:
            yield moving
        return
    started = time.monotonic()
    last = started
    first = 0

    def update(done: int, total: int) -> None:
        nonlocal last, first
        now = time.monotonic()
        first = first or done
        if now - last < _LINE_EVERY_S:
            return
        last = now
        # Steps finished before a resume cost no time now.
        rate = (done - first + 1) / (now - started)
        left_s = (total - done) / max(rate, 1e-9)
        say(f"  {name}: {done}/{total}, {now - started:.0f} s, about {left_s:.0f} s left")

    say(f"  {name} ...")
    yield update
    say(f"  {name}: done in {time.monotonic() - started:.0f} s")


@contextmanager
def stage_bars(what: str) -> Iterator[Callable[[str, int, int], None]]:
    """Yields `update(stage, done, total)`; every stage has a progress bar of its own."""
    with ExitStack() as bars:
        updates: dict[str, Callable[[int, int], None]] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in updates:
                bars.close()
                updates[stage] = bars.enter_context(progress_bar(f"{stage} {what}"))
            updates[stage](done, total)

        yield update


@contextmanager
def _moving_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    # Imported here, because help and refusals must answer at once.
    from rich import progress

    columns = (
        progress.TextColumn("{task.description:<28}"),
        progress.BarColumn(bar_width=30),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    )
    with progress.Progress(*columns) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
