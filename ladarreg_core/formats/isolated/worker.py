"""The reader process: runs one function at a time for its parent, and ends with it."""

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
)
_LARGEST_REQUEST = 1 << 40
_REPORT_INTERVAL_S = 0.05
_REUSE_LIMIT_BYTES = 512 << 20
"""A process whose memory has exceeded this is not reused, since it may not return all of it to the system."""
_LONGEST_TRACE = 4000
_ALARM_MARGIN_S = 5.0


def main() -> None:
    """Serve the parent process through standard input and output until it closes them."""
    incoming, outgoing = _claim_streams()
    _set_up_process()
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, requests), name="requests", daemon=True).start()
    for name in _PRELOADED:
        if not requests.empty():  # it imports what it needs
            break
        with suppress(ImportError):
            importlib.import_module(name)
    while True:
        _serve(requests.get(), incoming, outgoing)


def _claim_streams() -> tuple[IO[bytes], IO[bytes]]:
    """Reserve standard input and output for messages, since native libraries print there, and return them."""
    incoming, outgoing = os.dup(0), os.dup(1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return os.fdopen(incoming, "rb"), os.fdopen(outgoing, "wb")


def _set_up_process() -> None:
    """Ignore Ctrl-C, which the parent handles, and disable core files."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        import resource

        # With a limit of 0 Linux still pipes a core to a handler; with 1 it does not.
        resource.setrlimit(resource.RLIMIT_CORE, (1, 1) if sys.platform == "linux" else (0, 0))


def _receive(incoming: IO[bytes], requests: queue.SimpleQueue[Any]) -> None:
    """Queue the parent's requests; exit when the parent has ended."""
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
        limits.remove(incoming)
        send(message | {"worn": _peak_bytes() > _REUSE_LIMIT_BYTES})

    limits = _Limits(request["memory_bytes"], request["silent_s"])
    try:
        function = _function(request)
        limits.apply(incoming)
        send({"progress": None})  # everything is loaded; from now on the time limits of the file apply
        kwargs = dict(request["kwargs"])
        if "report" in inspect.signature(function).parameters:
            kwargs["report"] = _ProgressSender(send, limits.restart_alarm)
        answer({"answer": function(*request["args"], **kwargs)})
    except LadarregError as error:
        answer({"error": type(error).__name__, "text": str(error)})
    except MemoryError:
        answer({"memory": True})
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        answer({"fault": type(error).__name__, "trace": text[-_LONGEST_TRACE:]})


def _function(request: dict[str, Any]) -> Callable[..., Any]:
    """Return the requested function, after changing to the parent's working folder."""
    with suppress(OSError):
        os.chdir(request["folder"])
    found: Callable[..., Any] = getattr(importlib.import_module(request["module"]), request["name"])
    return found


class _ProgressSender:
    """The `report` of a reader: forwards progress to the parent at a limited rate."""

    def __init__(self, send: Callable[[Any], None], restart_alarm: Callable[[], None]) -> None:
        self._send, self._restart_alarm = send, restart_alarm
        self._last = Progress(-1, 0, "")
        self._sent_at = 0.0

    def __call__(self, progress: Progress) -> None:
        new_label = progress.label != self._last.label
        if not new_label and progress.done <= self._last.done:
            return
        self._last = progress
        self._restart_alarm()
        now = time.monotonic()
        if new_label or now - self._sent_at >= _REPORT_INTERVAL_S:
            self._sent_at = now
            self._send({"progress": [int(progress.done), int(progress.total), str(progress.label)]})


class _Limits:
    """Limits of one read that the operating system enforces, so that they also apply to native code.

    The parent watches the time as well; the alarm here is for the case that the parent has ended.
    """

    def __init__(self, memory_bytes: int, silent_s: float) -> None:
        self._memory_bytes, self._silent_s = memory_bytes, silent_s

    def apply(self, incoming: IO[bytes]) -> None:
        """Apply the limits; from now on the end of the parent ends this process even inside native code."""
        self.restart_alarm()
        if sys.platform == "linux":
            import fcntl
            import resource
            import select

            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            wanted = _data_bytes() + self._memory_bytes
            resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))
            # The thread that reads requests cannot run while native code holds the GIL. The parent sends nothing
            # during a read, so any event on its pipe means that it has ended: SIGIO, which ends this process.
            descriptor = incoming.fileno()
            fcntl.fcntl(descriptor, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(descriptor, fcntl.F_SETFL, fcntl.fcntl(descriptor, fcntl.F_GETFL) | os.O_ASYNC)
            poll = select.poll()
            poll.register(descriptor, 0)
            if poll.poll(0):  # the parent ended just before
                os._exit(0)

    def restart_alarm(self) -> None:
        """Restart the time limit without progress."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self._silent_s + _ALARM_MARGIN_S)

    def remove(self, incoming: IO[bytes]) -> None:
        """Remove the limits before the answer is sent."""
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
    """Return the current memory that counts towards RLIMIT_DATA, bytes."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) << 10 for line in status if line.startswith("VmData"))


def _peak_bytes() -> int:
    """Return the peak resident memory, bytes; 0 where the system does not report it."""
    if sys.platform == "win32":
        return 0
    if sys.platform == "linux":  # the figure of `getrusage` there begins at that of the process that started this one
        with suppress(OSError, StopIteration, ValueError, IndexError), open("/proc/self/status", "rb") as status:
            return int(next(line for line in status if line.startswith(b"VmHWM:")).split()[1]) << 10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10
