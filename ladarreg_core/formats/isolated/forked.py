"""A read in a confined process that is forked from this one: what commands use, which read one file and end.

A pool of reader processes pays where many files are read; a command would wait for it to load what the command loads
itself. Within `confined_reads`, `read_scan` and `read_photo` read so, whatever calls them. A fork needs a process with
a single thread: a child has none of the others, and libraries that wait for theirs would hang. With more of them, and
on systems other than Linux, which confine nothing, the file is read in this process.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from types import TracebackType
from typing import IO, Any, Generic, ParamSpec, TypeVar

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.isolated.readers import (
    FileState,
    ReaderLimits,
    error_in,
    invalid_answer,
    states_of,
    why_it_ended,
)
from ladarreg_core.progress import Progress, Report

P = ParamSpec("P")
T = TypeVar("T")

_CONFINES: ContextVar[bool] = ContextVar("confines", default=False)
_FIRST_INHERITED = 3
_CHECKS, _CHECK_S = 5, 0.001
_LIMITS = ReaderLimits(most_memory_bytes=1 << 62, most_silent_s=86_400.0)
"""Those of the readers' own budget: nobody else shares the machine with a command's file."""


@contextmanager
def confined_reads() -> Iterator[None]:
    """Have the files that are read in this context read in confined processes, where the system can: for commands."""
    before = _CONFINES.set(True)
    try:
        yield
    finally:
        _CONFINES.reset(before)


def read_confined(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function of a file in a process that can open nothing else, and return its result.

    Args:
        function: a reader; what it imports is best imported before.
        args: positional arguments; the first one is the file.
        kwargs: keyword arguments.

    Raises:
        LadarregError: as raised by the function, with the same type and text.
        FormatError: if the process crashed, hung, or exceeded its memory limit.
    """
    with confined_reads(), BegunRead(function, args, kwargs) as read:
        return read.result()


class BegunRead(Generic[T]):
    """A read that has begun in a confined process, within `confined_reads`; otherwise it begins with `result`.

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
        self._file, self._child, self._started = FileState.of(function, self._args), 0, 0.0
        self._stream: IO[bytes] | None = None
        if _CONFINES.get() and sys.platform == "linux" and threading.active_count() == 1:
            self._begin()

    def __enter__(self) -> BegunRead[T]:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end()

    @property
    def is_elsewhere(self) -> bool:
        """Whether the file is read in another process."""
        return self._stream is not None

    def result(self, report: Report | None = None) -> T:
        """Return the result; to be called once.

        Args:
            report: receives the progress; if it raises, the read ends.

        Raises:
            LadarregError: as raised by the function, with the same type and text.
            FormatError: if the process crashed, hung, or exceeded its memory limit.
        """
        if self._stream is None:
            told = {} if report is None else {"report": report}
            return self._finish(self._function(*self._args, **self._kwargs, **told))
        answer = None
        try:
            with suppress(EOFError):
                answer = _answer(self._stream, self._file, report)
        finally:
            seconds = time.monotonic() - self._started
            code = self._end(has_ended=answer is None and sys.exc_info()[0] is None)
        if answer is None:
            raise FormatError(str(why_it_ended(self._file, code, seconds)))
        if (error := error_in(answer, self._file)) is not None:
            raise error
        return self._finish(answer["answer"])

    def _begin(self) -> None:
        given = [*self._args, *self._kwargs.values()]
        size = max(self._file.bytes, sum(size for _, size, _ in states_of(given)))
        request = {
            "args": list(self._args),
            "kwargs": self._kwargs,
            "folder": os.getcwd(),
            "memory_bytes": _LIMITS.memory_for(size),
            "silent_s": _LIMITS.silence_for(size),
            "origins": [],
        }
        receiving, sending = os.pipe()
        parent = os.getpid()
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        with warnings.catch_warnings():
            # Of threads, of which OpenBLAS has some: it ends them before a fork, and starts others when needed.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._child = os.fork()
        if self._child == 0:
            try:
                _CONFINES.set(False)
                _serve(request, self._function, sending, parent)
            finally:
                os._exit(1)
        os.close(sending)
        self._started = time.monotonic()
        self._stream = os.fdopen(receiving, "rb")
        if not _is_single_threaded():
            self._end()
            self._stream = None

    def _end(self, *, has_ended: bool = False) -> int:
        """End the process, which has nothing more to do, and return its exit code."""
        child, self._child = self._child, 0
        if child == 0:
            return 0
        if not has_ended:
            os.kill(child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert self._stream is not None
        self._stream.close()
        return code


def _is_single_threaded() -> bool:
    """Return whether this process, which has just forked, has no threads of libraries either."""
    for _ in range(_CHECKS):  # those that OpenBLAS has ended may be listed for a moment
        if len(os.listdir("/proc/self/task")) == 1:
            return True
        time.sleep(_CHECK_S)
    return False


def _answer(stream: IO[bytes], file: FileState, report: Report | None) -> dict[str, Any]:
    """Return the answer of the child, and report its progress until then.

    Raises:
        EOFError: if it ends without one.
        FormatError: if it sends something else.
    """
    from ladarreg_core.formats.isolated.messages import MessageError, read_message
    from ladarreg_core.formats.untrusted import one_line

    while True:
        try:
            message = read_message(stream, largest_bytes=_LIMITS.result_bytes)
            if "progress" not in message:
                return dict(message)
            if message["progress"] is None or report is None:
                continue
            done, total, label = message["progress"]
            progress = Progress(int(done), int(total), one_line(label))
        except (MessageError, TypeError, ValueError) as error:
            raise invalid_answer(file) from error
        report(progress)


def _serve(request: dict[str, Any], function: Callable[..., Any], sending: int, parent: int) -> None:
    """Serve the request in the child, which keeps nothing of its parent but the pipe."""
    from ladarreg_core.formats.isolated import worker

    worker.end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(_FIRST_INHERITED):
        os.dup2(nothing, descriptor)
    os.closerange(_FIRST_INHERITED, sending)
    os.closerange(sending + 1, os.sysconf("SC_OPEN_MAX"))
    worker.serve_one(request, function, sending)
