"""A read in a confined process that is forked from this one: what commands use, which read one file and end.

A pool of reader processes pays where many files are read; a command would wait for it to load what the command loads
itself. A fork needs a process with a single thread; with more of them, and on systems other than Linux, which confine
nothing, the file is read in this process.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any, ParamSpec, TypeVar

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.isolated.readers import (
    FileState,
    ReaderLimits,
    error_in,
    invalid_answer,
    why_it_ended,
)

P = ParamSpec("P")
T = TypeVar("T")

_FIRST_INHERITED = 3
_LIMITS = ReaderLimits(most_memory_bytes=1 << 62, most_silent_s=86_400.0)
"""Those of the readers' own budget: nobody else shares the machine with a command's file."""


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
    if sys.platform != "linux" or threading.active_count() > 1:
        return function(*args, **kwargs)
    limits, file = _LIMITS, FileState.of(function, args)
    request = {
        "args": list(args),
        "kwargs": dict(kwargs),
        "folder": os.getcwd(),
        "memory_bytes": limits.memory_for(file.bytes),
        "silent_s": limits.silence_for(file.bytes),
        "origins": [],
    }
    receiving, sending = os.pipe()
    parent = os.getpid()
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings():
        # Of threads, of which OpenBLAS has some: it ends them before a fork, and starts others when they are needed.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            _serve(request, function, sending, parent)
        finally:
            os._exit(1)
    os.close(sending)
    started, answer = time.monotonic(), None
    try:
        with os.fdopen(receiving, "rb") as stream, suppress(EOFError):
            answer = _answer(stream, limits, file)
    except BaseException:  # an answer that is none, or Ctrl-C
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    if answer is not None:  # it has nothing more to do
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if answer is None:
        raise FormatError(str(why_it_ended(file, code, time.monotonic() - started)))
    if (error := error_in(answer, file)) is not None:
        raise error
    return answer["answer"]  # type: ignore[no-any-return]


def _answer(stream: IO[bytes], limits: ReaderLimits, file: FileState) -> dict[str, Any]:
    """Return the answer of the child.

    Raises:
        EOFError: if it ends without one.
        FormatError: if it sends something else.
    """
    from ladarreg_core.formats.isolated.messages import MessageError, read_message

    while True:
        try:
            message = read_message(stream, largest_bytes=limits.result_bytes)
        except MessageError as error:
            raise invalid_answer(file) from error
        if not isinstance(message, dict):
            raise invalid_answer(file)
        if "progress" not in message:
            return message


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
