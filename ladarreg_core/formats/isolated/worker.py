"""The reader process: runs one function after another for its parent, and ends with it."""

from __future__ import annotations

import importlib
import inspect
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.progress import Progress

_PRELOADED = (
    "ladarreg_core.formats.isolated.messages",
    "ladarreg_core.formats.registry",
    "ladarreg_core.formats.photo_file",
    "ladarreg_core.formats.matches_file",
    "PIL.Image",
    "pye57.libe57",
)
_LARGEST_REQUEST = 1 << 40
_TOLD_EVERY_S = 0.05
_KEPT_BYTES = 512 << 20
"""A process that has held more is not used again: it may not give all of it back."""
_LONGEST_TRACE = 4000
_ALARM_MARGIN_S = 5.0


def main() -> None:
    """Serve the parent at the other end of standard input and output until it goes."""
    incoming, outgoing = _taken_streams()
    _settle_in()
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, requests), name="requests", daemon=True).start()
    for name in _PRELOADED:
        if not requests.empty():  # what it needs is imported on the way
            break
        with suppress(ImportError):
            importlib.import_module(name)
    while True:
        _serve(requests.get(), incoming, outgoing)


def _taken_streams() -> tuple[IO[bytes], IO[bytes]]:
    """Return standard input and output for the messages alone: native libraries print there."""
    incoming, outgoing = os.dup(0), os.dup(1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return os.fdopen(incoming, "rb"), os.fdopen(outgoing, "wb")


def _settle_in() -> None:
    """Leave Ctrl-C to the parent, and leave no core file behind."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        import resource

        # Linux hands a core to a program even where the limit is 0, but never where it is 1.
        resource.setrlimit(resource.RLIMIT_CORE, (1, 1) if sys.platform == "linux" else (0, 0))


def _receive(incoming: IO[bytes], requests: queue.SimpleQueue[Any]) -> None:
    """Queue the parent's requests; end the process when the parent has gone."""
    from ladarreg_core.formats.isolated.messages import read_message

    try:
        while True:
            requests.put(read_message(incoming, largest_bytes=_LARGEST_REQUEST))
    except BaseException:
        os._exit(0)


def _serve(request: dict[str, Any], incoming: IO[bytes], outgoing: IO[bytes]) -> None:
    from ladarreg_core.formats.isolated.messages import write_message

    def send(message: dict[str, Any]) -> None:
        write_message(outgoing, message)

    def answer(message: dict[str, Any]) -> None:
        limits.lift(incoming)
        send(message | {"worn": _peak_bytes() > _KEPT_BYTES})

    limits = _Limits(request["memory_bytes"], request["silent_s"])
    try:
        function = _function(request)
        limits.set(incoming)
        send({"progress": None})  # all is loaded; from now on it is the file's time
        kwargs = dict(request["kwargs"])
        if "report" in inspect.signature(function).parameters:
            kwargs["report"] = _Teller(send, limits.go_on)
        answer({"answer": function(*request["args"], **kwargs)})
    except LadarregError as error:
        answer({"error": type(error).__name__, "text": str(error)})
    except MemoryError:
        answer({"memory": True})
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        answer({"fault": type(error).__name__, "trace": text[-_LONGEST_TRACE:]})


def _function(request: dict[str, Any]) -> Callable[..., Any]:
    """Return the function that is asked for, with the parent's working folder set."""
    with suppress(OSError):
        os.chdir(request["folder"])
    found: Callable[..., Any] = getattr(importlib.import_module(request["module"]), request["name"])
    return found


class _Teller:
    """The `report` of a reader: passes on what advances, but not too often."""

    def __init__(self, send: Callable[[Any], None], go_on: Callable[[], None]) -> None:
        self._send, self._go_on = send, go_on
        self._last = Progress(-1, 0, "")
        self._told = 0.0

    def __call__(self, progress: Progress) -> None:
        new_label = progress.label != self._last.label
        if not new_label and progress.done <= self._last.done:
            return
        self._last = progress
        self._go_on()
        now = time.monotonic()
        if new_label or now - self._told >= _TOLD_EVERY_S:
            self._told = now
            self._send({"progress": [int(progress.done), int(progress.total), str(progress.label)]})


class _Limits:
    """The limits of one read that the operating system keeps, so that they hold in native code too.

    The parent watches the time as well; these hold where the parent has gone.
    """

    def __init__(self, memory_bytes: int, silent_s: float) -> None:
        self._memory_bytes, self._silent_s = memory_bytes, silent_s

    def set(self, incoming: IO[bytes]) -> None:
        """Set them; from now on the process also ends with its parent inside native code."""
        self.go_on()
        if sys.platform == "linux":
            import fcntl
            import resource
            import select

            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            wanted = _data_bytes() + self._memory_bytes
            resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))
            # The thread that reads requests cannot run while native code holds the interpreter. The parent sends
            # nothing during a read, so that any event on its pipe is its end: SIGIO, whose default is to end.
            descriptor = incoming.fileno()
            fcntl.fcntl(descriptor, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(descriptor, fcntl.F_SETFL, fcntl.fcntl(descriptor, fcntl.F_GETFL) | os.O_ASYNC)
            poll = select.poll()
            poll.register(descriptor, 0)
            if poll.poll(0):  # it went just before
                os._exit(0)

    def go_on(self) -> None:
        """Begin the time of silence anew."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self._silent_s + _ALARM_MARGIN_S)

    def lift(self, incoming: IO[bytes]) -> None:
        """Lift them: the answer is sent, and requests come again."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        if sys.platform == "linux":
            import fcntl
            import resource

            descriptor = incoming.fileno()
            fcntl.fcntl(descriptor, fcntl.F_SETFL, fcntl.fcntl(descriptor, fcntl.F_GETFL) & ~os.O_ASYNC)
            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def _data_bytes() -> int:
    """Return what counts towards RLIMIT_DATA now."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) << 10 for line in status if line.startswith("VmData"))


def _peak_bytes() -> int:
    """Return the largest resident memory so far; 0 where the system does not tell it."""
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10
