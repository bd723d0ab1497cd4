"""Makes the next item in a thread while the present one is in use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def made_ahead(make: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """Yields `make(item)` for each item in order, and makes the next one in a thread meanwhile.

    At most two results exist at a time. An error of `make` is raised in place of its result. `make`
    must not depend on the consumer's use of earlier results.
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
