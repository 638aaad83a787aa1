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
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import IO, Any, ParamSpec, TypeVar

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.isolated.readers import (
    FileState,
    ReaderLimits,
    error_in,
    invalid_answer,
    states_of,
    why_it_ended,
)
from ladarreg_core.formats.parsing.begun_read import BegunRead, reads_started_by
from ladarreg_core.foundations.progress import Progress, Report

P = ParamSpec("P")
T = TypeVar("T")

_FIRST_INHERITED = 3
_CHECKS, _CHECK_S = 5, 0.001
_LIMITS = ReaderLimits(most_memory_bytes=1 << 62, most_silent_s=86_400.0)
"""Those of the readers' own budget: nobody else shares the machine with a command's file."""


def confined_reads() -> AbstractContextManager[None]:
    """Have the files that are read in this context read in confined processes, where the system can: for commands."""
    return reads_started_by(_begin)


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


class _ForkedRead:
    """A read in a confined process that was forked for it."""

    def __init__(self, child: int, receiving: int, file: FileState) -> None:
        self._child, self._file, self._started = child, file, time.monotonic()
        self._stream = os.fdopen(receiving, "rb")

    def result(self, report: Report | None) -> Any:
        answer = None
        try:
            with suppress(EOFError):
                answer = _answer(self._stream, self._file, report)
        except BaseException:  # an answer that is none, or Ctrl-C
            self.end()
            raise
        seconds = time.monotonic() - self._started
        code = self.end(has_ended=answer is None)
        if answer is None:
            raise FormatError(str(why_it_ended(self._file, code, seconds)))
        if (error := error_in(answer, self._file)) is not None:
            raise error
        return answer["answer"]

    def end(self, *, has_ended: bool = False) -> int:
        """End the process, which has nothing more to do, and return its exit code."""
        child, self._child = self._child, 0
        if child == 0:
            return 0
        if not has_ended:
            os.kill(child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if threading.current_thread() is threading.main_thread():  # another one may be reading, and closes it then
            self._stream.close()
        return code


def _begin(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> _ForkedRead | None:
    """Fork a process that reads a file; None where that is not possible."""
    if sys.platform != "linux" or threading.active_count() > 1:
        return None
    file = FileState.of(function, args)
    size = max(file.bytes, sum(size for _, size, _ in states_of([*args, *kwargs.values()])))
    request = {
        "args": list(args),
        "kwargs": kwargs,
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
        # Of threads, of which OpenBLAS has some: it ends them before a fork, and starts others when they are needed.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            with reads_started_by(None):
                _serve(request, function, sending, parent)
        finally:
            os._exit(1)
    os.close(sending)
    begun = _ForkedRead(child, receiving, file)
    if _is_single_threaded():
        return begun
    begun.end()
    return None


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
    from ladarreg_core.formats.parsing.untrusted import one_line

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
