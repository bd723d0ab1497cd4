"""Making the next thing in a thread while the present one is in use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def made_ahead(make: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """Yields `make(item)` for each item in order; the next is being made meanwhile in a thread.

    At most two results exist at a time: the one in use and the next. An error of `make` is raised
    where its result would have come.

    Args:
        make: must not depend on what the user of the results does meanwhile.
        items: what to make results of.
    """
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="ahead") as maker:
        waiting: Future[Made] | None = None
        for item in items:
            upcoming = maker.submit(make, item)
            if waiting is not None:
                yield waiting.result()
            waiting = upcoming
        if waiting is not None:
            yield waiting.result()
