"""What the command line prints: stages, progress with time left, one sentence for an error."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

# Without a terminal (a log file, CI) a line now and then replaces the moving bar.
_LINE_EVERY_S = 15.0

# The time left is shown once this many seconds, or this share of the work, have been measured.
_TRUSTED_S = 60.0
_TRUSTED_SHARE = 0.05

# Names in files of strangers may be of any length.
_LONGEST_WORD = 300
_LONGEST_ERROR = 1400
_LONGEST_LINE = 4000
# Between a number and its unit.
_THIN_SPACE = "\u202f"


def say(message: str) -> None:
    """Prints one line, or several."""
    _print("\n".join(_shown(line, _LONGEST_LINE) for line in message.split("\n")), sys.stdout)


def say_error(message: str) -> None:
    """Prints one line to standard error."""
    # Messages of libraries may hold line breaks.
    words = (shortened(word, _LONGEST_WORD) for word in message.split())
    _print(f"skyproof: {_shown(' '.join(words), _LONGEST_ERROR)}", sys.stderr)


def shortened(text: str, most: int) -> str:
    """Shortens a text to about `most` characters, with dots for what is left out inside."""
    if len(text) <= most:
        return text
    return f"{text[: most * 2 // 3]}...{text[-(most // 3) :]}"


def _shown(line: str, most: int) -> str:
    """Makes a line safe to print: names in files may hold what moves a terminal's cursor."""
    line = shortened(line, most)
    return "".join(sign if sign.isprintable() or sign == _THIN_SPACE else "?" for sign in line)


def _print(line: str, stream: Any) -> None:
    try:
        print(line, file=stream, flush=True)
    except UnicodeEncodeError:
        # A terminal without these letters, or the name of a file that is no text.
        encoding = stream.encoding or "ascii"
        print(line.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def duration(seconds: float) -> str:
    """A time in words."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{seconds / 3600:.1f} h"


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """Yields `update(done, total)`; shows name, progress, time used and time left."""
    if sys.stdout.isatty():
        with _moving_bar(name) as moving:
            yield moving
        return
    started = time.monotonic()
    last = started
    first: tuple[int, float] | None = None

    def update(done: int, total: int) -> None:
        nonlocal last, first
        now = time.monotonic()
        # Steps before a resume took no time in this run, and the first one often takes long.
        first = first or (done, now)
        if now - last < _LINE_EVERY_S:
            return
        last = now
        more, took_s = done - first[0], now - first[1]
        trusted = more > 0 and (took_s >= _TRUSTED_S or more >= _TRUSTED_SHARE * (total - first[0]))
        left = f", about {duration(took_s / more * (total - done))} left" if trusted else ""
        say(f"  {name}: {done}/{total}, {duration(now - started)}{left}")

    say(f"  {name} ...")
    yield update
    say(f"  {name}: done in {duration(time.monotonic() - started)}")


@contextmanager
def stage_bars(what: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Yields `update(stage, done, total)`; every stage has a progress bar of its own."""
    with ExitStack() as bars:
        updates: dict[str, Callable[[int, int], None]] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in updates:
                bars.close()
                updates[stage] = bars.enter_context(progress_bar(f"{stage} {what}".rstrip()))
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
