"""Independent pieces of work on two processor cores, with results that do not depend on the number of threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock, RLock
from types import TracebackType
from typing import Any, Generic, TypeVar

import cv2

_THREADS = 2  # NumPy and OpenCV release the interpreter for parts of the work only: more threads gain nothing
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_alone: ContextVar[bool] = ContextVar("_alone", default=False)


class _OpenCvAlone:
    """OpenCV's pool, one for the process: of one thread while anybody asks for that, then of as many as before."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._asking = 0
        self._before = 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._asking:
                self._before = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._asking += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._lock:
            self._asking -= 1
            if not self._asking:
                cv2.setNumThreads(self._before)


_opencv_alone = _OpenCvAlone()


@contextmanager
def one_thread() -> Iterator[None]:
    """Work in the calling thread only: what is here begins no other, and OpenCV uses one thread.

    OpenCV has one pool for the whole process, so that other threads of the program are slower meanwhile. Its size is as
    before once the last of several such blocks, one in another or side by side, has ended, with an error or without.
    """
    before = _alone.set(True)
    try:
        with _opencv_alone:
            yield
    finally:
        _alone.reset(before)


def _may_begin_another() -> bool:
    return (os.cpu_count() or 1) > 1 and not _alone.get()


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
    if len(waiting) < 2 or not _may_begin_another():
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


class Begun(Generic[_Result]):
    """Work that `OtherCore` was asked to begin."""

    def __init__(self, work: Callable[[], _Result], future: Future[_Result] | None) -> None:
        self._work = work
        self._future = future

    def result(self) -> _Result:
        """Return the result of the work, which is done here if it has not been begun; to be called once.

        Raises:
            Exception: what the work raised.
        """
        if self._future is None or self._future.cancel():
            return self._work()
        return self._future.result()


class OtherCore:
    """Begins, in a second thread, work whose result is needed soon, piece by piece in the order of the calls.

    At the end of its `with` block, what has not been begun is dropped and the piece at work is waited for. With one
    processor core, or made within `one_thread`, nothing is begun ahead.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1) if _may_begin_another() else None

    def __enter__(self) -> OtherCore:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def begin(self, work: Callable[[], _Result]) -> Begun[_Result]:
        """Begin a piece of work, which changes nothing that other work reads; what it needs must have been begun.

        An error is raised where the result is asked for, and nowhere if it is not.
        """
        return Begun(work, None if self._pool is None else self._pool.submit(work))


class made_once(Generic[_Result]):  # noqa: N801 - used as a decorator, as `cached_property` is
    """A cached property that two threads may ask for at once: one of them computes it, and the other one waits."""

    def __init__(self, make: Callable[[Any], _Result]) -> None:
        self._make = make
        self.__doc__ = make.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type | None = None) -> _Result:
        kept = vars(instance)
        with kept.setdefault(f"_lock of {self._name}", RLock()):
            if self._name not in kept:
                kept[self._name] = self._make(instance)
        made: _Result = kept[self._name]
        return made
