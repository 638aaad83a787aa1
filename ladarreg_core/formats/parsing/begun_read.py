"""A read of a file that has begun, in this process or wherever the surrounding context has files read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

from ladarreg_core.foundations.progress import Report

T = TypeVar("T")


class ReadElsewhere(Protocol):
    """A read under way in another process."""

    def result(self, report: Report | None) -> Any:
        """Return what was read; raises as the reader does."""

    def end(self) -> object:
        """End the process, if it has not ended."""


Starter = Callable[[Callable[..., Any], tuple[Any, ...], dict[str, Any]], ReadElsewhere | None]
"""Starts a read of a function with its arguments elsewhere; None where that is not possible."""
_STARTER: ContextVar[Starter | None] = ContextVar("starter", default=None)


@contextmanager
def reads_started_by(starter: Starter | None) -> Iterator[None]:
    """Have the reads that begin in this context started so; None: in this process."""
    before = _STARTER.set(starter)
    try:
        yield
    finally:
        _STARTER.reset(before)


class BegunRead(Generic[T]):
    """A read that has begun elsewhere, within `reads_started_by`; in this process it begins with `result`.

    Args:
        function: a reader; if it takes `report`, its progress is passed on.
        args: its positional arguments; the first one is the file.
        kwargs: its keyword arguments.
        finish: completes what was read, in this process.
    """

    def __init__(
        self,
        function: Callable[..., T],
        args: Sequence[Any],
        kwargs: Mapping[str, Any],
        *,
        finish: Callable[[T], T] = lambda read: read,
    ) -> None:
        self._function, self._args, self._kwargs, self._finish = function, tuple(args), dict(kwargs), finish
        starter = _STARTER.get()
        self._elsewhere = None if starter is None else starter(function, self._args, self._kwargs)

    def __enter__(self) -> BegunRead[T]:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._elsewhere is not None:
            self._elsewhere.end()

    @property
    def is_elsewhere(self) -> bool:
        """Whether the file is read in another process."""
        return self._elsewhere is not None

    def result(self, report: Report | None = None) -> T:
        """Return the result; to be called once.

        Args:
            report: receives the progress; if it raises, the read ends.

        Raises:
            LadarregError: as raised by the function, with the same type and text.
            FormatError: if another process crashed, hung, or exceeded its memory limit.
        """
        if self._elsewhere is not None:
            return self._finish(self._elsewhere.result(report))
        told = {} if report is None else {"report": report}
        return self._finish(self._function(*self._args, **self._kwargs, **told))
