"""Independent pieces of work on two processor cores, with results that do not depend on the number of threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_THREADS = 2  # NumPy and OpenCV let go of the interpreter for parts of the work only: more threads gain nothing
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def side_by_side(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, before: Callable[[int], None] | None = None
) -> list[_Result]:
    """Return the results of `work` for all items, in their order.

    Args:
        work: a function of one item, which changes nothing that the work on another item reads.
        items: the items.
        before: called in this thread with the number of every item, in their order, before its result is waited for; if
            it raises, no further item is begun.

    Raises:
        Exception: the first error, in the order of the items.
    """
    waiting = list(items)
    tell = before or (lambda _: None)
    done: list[_Result] = []
    if len(waiting) < 2 or (os.cpu_count() or 1) < 2:
        for k, item in enumerate(waiting):
            tell(k)
            done.append(work(item))
        return done
    with ThreadPoolExecutor(_THREADS - 1) as others:
        # This thread works from the front and the other one from the back, until they meet.
        promised = {k: others.submit(work, waiting[k]) for k in reversed(range(len(waiting)))}
        try:
            for k, item in enumerate(waiting):
                tell(k)
                done.append(work(item) if promised[k].cancel() else promised[k].result())
        finally:
            for later in promised.values():
                later.cancel()
    return done
