"""The reader process: runs functions of files for its parent, each in a confined process of its own, and ends with it.

On Linux this process only loads the readers. It has one thread and never opens a file of a request: for each request it
forks a process, which confines itself (`confinement`) before it opens the file, and ends with its answer. What that
process sends is passed on in pieces with their lengths, so that it cannot speak for another one. Elsewhere there is no
confinement, forking is unsafe or unknown, and this process runs the functions itself, one after the other.
"""

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
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from ladarreg_core.errors import CameraError, LadarregError, OptionError
from ladarreg_core.formats.isolated.pieces import write_piece
from ladarreg_core.foundations.progress import Progress

_PRELOADED = (
    "ladarreg_core.formats.isolated.messages",
    "ladarreg_core.formats.isolated.confinement",
    "ladarreg_core.scanner.origin",
    "ladarreg_core.formats.registry",
    "ladarreg_core.formats.photo_file",
    "ladarreg_core.formats.documents.matches_file",
    "PIL.ImageOps",
    "PIL.JpegImagePlugin",
    "PIL.PngImagePlugin",
    "PIL.TiffImagePlugin",
    "tifffile",
    "scipy.spatial",
    "scipy.optimize",
    "laspy",
)
"""What readers import, the most frequent first. A process that is forked for a file imports the rest each time."""
_LARGEST_REQUEST = 1 << 40
_REPORT_INTERVAL_S = 0.05
_REUSE_LIMIT_BYTES = 512 << 20
"""Where no process is forked for a file, one whose memory has exceeded this is not used again: it may keep some."""
_LONGEST_TRACE = 4000
_ALARM_MARGIN_S = 5.0
_PASSED_ON_BYTES = 1 << 20
_ENDING_MS = 1
_PR_SET_PDEATHSIG = 1
_COMPANIONS: Mapping[str, tuple[str, ...]] = {
    ".json": ("",),  # a descriptor, or a result with its manifest: what it names lies in its folder
    ".yaml": ("",),  # of a recording
    ".yml": ("",),
    ".pcap": (".json",),
    ".pcapng": (".json",),
    ".txt": ("images.txt", "images.bin"),
    ".bin": ("images.txt", "images.bin"),
}
"""What readers open beside a file, by its ending: endings of names in its folder; empty: the folder."""


def main() -> None:
    """Serve the parent process through standard input and output until it closes them."""
    incoming, outgoing = _claim_streams()
    _set_up_process()
    if sys.platform == "linux":
        _serve_by_forking(incoming, outgoing)
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, requests), name="requests", daemon=True).start()
    to_load = list(_PRELOADED)
    while True:
        _preload(to_load, lambda: not requests.empty())
        _serve(requests.get(), lambda data: write_piece(outgoing, data))
        write_piece(outgoing, b"")


def _preload(names: list[str], is_asked: Callable[[], bool]) -> None:
    """Import modules, and remove their names from the list, until there is a request."""
    while names and not is_asked():
        with suppress(ImportError):
            importlib.import_module(names.pop(0))


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


def _serve_by_forking(incoming: IO[bytes], outgoing: IO[bytes]) -> None:
    """Have each request served by a process of its own, until the parent process ends."""
    import fcntl
    import select

    from ladarreg_core.formats.isolated.messages import read_message

    poll = select.poll()
    poll.register(incoming, select.POLLIN)
    to_load = list(_PRELOADED)
    while True:
        _preload(to_load, lambda: bool(poll.poll(0)))
        try:
            request = read_message(incoming, largest_bytes=_LARGEST_REQUEST)
        except BaseException:
            os._exit(0)
        try:
            function: Callable[..., Any] | Exception = _function(request)  # its modules serve later requests, too
        except Exception as error:
            function = error
        answers, sending = os.pipe()
        with suppress(OSError):  # beyond the user's limit; a larger pipe is only faster
            fcntl.fcntl(sending, fcntl.F_SETPIPE_SZ, _PASSED_ON_BYTES)
        server = os.getpid()
        try:
            child = os.fork()
        except OSError as error:
            os.close(answers)
            os.close(sending)
            _refuse(request, error, outgoing)
            continue
        if child == 0:
            try:
                end_with(server)
                for inherited in (answers, incoming.fileno(), outgoing.fileno()):
                    os.close(inherited)
                serve_one(request, function, sending)
            finally:
                os._exit(1)
        os.close(sending)
        _pass_on(child, answers, incoming, outgoing)


def _refuse(request: dict[str, Any], error: OSError, outgoing: IO[bytes]) -> None:
    """Answer that no process can be started."""
    from ladarreg_core.formats.isolated.messages import message_parts
    from ladarreg_core.formats.parsing.untrusted import shown_name

    name = shown_name(request["args"][0]) if request["args"] else "the file"
    text = f"{name}: it cannot be read now because no process can be started ({error.strerror}); try again"
    for part in message_parts({"error": "FormatError", "text": text, "worn": True}):
        write_piece(outgoing, part)
    write_piece(outgoing, b"")


def end_with(server: int) -> None:
    """Have the system kill this process when the one that forked it ends."""
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, ctypes.c_long(signal.SIGKILL))
    if os.getppid() != server:  # it has just ended
        os._exit(0)


def serve_one(request: dict[str, Any], function: Callable[..., Any] | Exception, sending: int) -> None:
    """Serve a request in the process that was forked for it."""
    from ladarreg_core.formats.isolated.confinement import confine

    confine(_readable(request))
    with os.fdopen(sending, "wb") as stream:

        def send(data: memoryview) -> None:
            stream.write(data)
            stream.flush()

        _serve(request, send, function)
    os._exit(0)


def _readable(request: dict[str, Any]) -> Iterator[Path]:
    """Yield the files and folders that a request may read: the paths in it and what lies beside them."""
    named = [Path(value) for value in request["args"][:1] if isinstance(value, str)]
    for found in (*named, *_paths([*request["args"], *request["kwargs"].values()])):
        path = Path(request["folder"], found)
        yield path
        for ending in _COMPANIONS.get(path.suffix.lower(), ()):
            if not ending:
                yield path.parent
                continue
            with suppress(OSError):
                others = [other for other in path.parent.iterdir() if other.name.lower().endswith(ending)]
                yield from (other for other in others if not other.is_symlink())  # it may lead anywhere


def _paths(values: Any) -> Iterator[Path]:
    for value in values:
        if isinstance(value, Path):
            yield value
        elif isinstance(value, list | tuple):
            yield from _paths(value)


def _pass_on(child: int, answers: int, incoming: IO[bytes], outgoing: IO[bytes]) -> None:
    """Pass on what the process of a request sends; end as it ended, unless it was as it should."""
    import select

    poll = select.poll()
    poll.register(answers, select.POLLIN)
    poll.register(incoming, 0)  # the parent sends nothing meanwhile: an event means that it has ended
    while True:
        events = dict(poll.poll())
        if incoming.fileno() in events:
            os.kill(child, signal.SIGKILL)
            os._exit(0)
        data = os.read(answers, _PASSED_ON_BYTES)
        if not data:
            break
        try:
            write_piece(outgoing, data)
        except OSError:
            os._exit(0)  # which ends the child
    poll.unregister(answers)
    os.close(answers)
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if poll.poll(_ENDING_MS):
            os.kill(child, signal.SIGKILL)
            os._exit(0)
    status = ended[1]
    if os.WIFSIGNALED(status):
        with suppress(OSError, ValueError):  # SIGKILL has no other disposition
            signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
        os.kill(os.getpid(), os.WTERMSIG(status))
    if code := os.waitstatus_to_exitcode(status):
        os._exit(code)
    write_piece(outgoing, b"")


def _receive(incoming: IO[bytes], requests: queue.SimpleQueue[Any]) -> None:
    """Queue the parent's requests; exit when the parent has ended."""
    from ladarreg_core.formats.isolated.messages import read_message

    try:
        while True:
            requests.put(read_message(incoming, largest_bytes=_LARGEST_REQUEST))
    except BaseException:
        os._exit(0)


def _serve(
    request: dict[str, Any],
    write: Callable[[memoryview], None],
    function: Callable[..., Any] | Exception | None = None,
) -> None:
    """Run the function of a request and send its progress and its answer.

    Args:
        request: the request.
        write: sends bytes.
        function: the function, or why there is none; None: it is still to be found.
    """
    from ladarreg_core.formats.isolated.messages import message_parts
    from ladarreg_core.scanner.origin import keep_answers, kept_answers

    def send(message: dict[str, Any]) -> None:
        for part in message_parts(message):
            write(part)

    def answer(message: dict[str, Any], *, is_clean: bool = False) -> None:
        limits.remove()
        worn = sys.platform != "linux" and (not is_clean or _peak_bytes() > _REUSE_LIMIT_BYTES)
        send(message | {"worn": worn, "origins": kept_answers()})

    limits = _Limits(request["memory_bytes"], request["silent_s"])
    try:
        if function is None:
            function = _function(request)
        if isinstance(function, Exception):
            raise function
        with suppress(ValueError, TypeError):
            keep_answers(request["origins"])
        limits.apply()
        send({"progress": None})  # everything is loaded; from now on the time limits of the file apply
        kwargs = dict(request["kwargs"])
        if "report" in inspect.signature(function).parameters:
            kwargs["report"] = _ProgressSender(send, limits.restart_alarm)
        answer({"answer": function(*request["args"], **kwargs)}, is_clean=True)
    except LadarregError as error:
        is_clean = isinstance(error, CameraError | OptionError)  # the caller's fault, not the file's
        answer({"error": type(error).__name__, "text": str(error)}, is_clean=is_clean)
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

    def apply(self) -> None:
        """Apply the limits."""
        self.restart_alarm()
        if sys.platform == "linux":
            import resource

            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            wanted = data_bytes() + self._memory_bytes
            resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))

    def restart_alarm(self) -> None:
        """Restart the time limit without progress."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self._silent_s + _ALARM_MARGIN_S)

    def remove(self) -> None:
        """Remove the limits before the answer is sent."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        if sys.platform == "linux":
            import resource

            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def data_bytes() -> int:
    """Return the current memory that counts towards RLIMIT_DATA, bytes."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) << 10 for line in status if line.startswith("VmData"))


def _peak_bytes() -> int:
    """Return the peak resident memory, bytes; 0 where the system does not report it."""
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10
