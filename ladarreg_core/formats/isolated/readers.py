"""Files read in a process of their own: a reader that hangs, crashes or takes too much memory costs its file only.

A scan or a picture goes through native decoders, and a damaged or hostile file may take down the process that they run
in. `IsolatedReaders` runs any reader of `ladarreg_core.formats` (or any other importable function of paths and plain
values) in a child process with limits on memory and time, and returns what it returned:

    readers = IsolatedReaders()
    scan = readers.run(read_scan, path, scan_index=1)

Messages are described in `messages`, the child's side in `worker`. This module imports nothing heavy, so that the
first child can start before anything else.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from ladarreg_core import errors
from ladarreg_core.errors import CameraError, FormatError, LadarregError, OptionError
from ladarreg_core.progress import Progress, Report

P = ParamSpec("P")
T = TypeVar("T")

_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from ladarreg_core.formats.isolated.worker import main; main()"
_TICK_S = 0.25
_START_S = 60.0
_END_S = 5.0
_PIPE_BYTES = 1 << 20
_DAMAGED = "the file is probably damaged: copy or export it again"
_HARMLESS = (CameraError, OptionError)
_FOLLOWS_DESCRIPTORS = ("read_scan", "describe")
_REMEMBERED = 256

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderLimits:
    """What one read may cost."""

    memory_bytes: int = 1 << 30
    """Beyond what the process holds before. Kept by Linux; elsewhere only by the budget of the readers themselves."""
    memory_per_file_byte: float = 32.0
    """More for large files: bytes for each of the file's."""
    most_memory_bytes: int = 6 << 30
    """The most, however large the file."""
    silent_s: float = 30.0
    """Time without any progress after which a reader counts as hanging."""
    silent_s_per_mb: float = 2.0
    """More for large files: not every reader reports progress."""
    most_silent_s: float = 300.0
    """The most, however large the file."""
    longest_s: float = 3600.0
    """Time after which a reader is stopped, whatever it reports."""
    result_bytes: int = 6 << 30
    """The largest result."""

    def memory_for(self, file_bytes: int) -> int:
        """Return how much memory the reader of a file of that size may take."""
        return int(min(self.memory_bytes + self.memory_per_file_byte * file_bytes, self.most_memory_bytes))

    def silence_for(self, file_bytes: int) -> float:
        """Return how long the reader of a file of that size may report nothing."""
        return min(self.silent_s + self.silent_s_per_mb * file_bytes / 2**20, max(self.silent_s, self.most_silent_s))


class IsolatedReaders:
    """Reader processes: one waits ready, others are started where several files are read at the same time.

    Args:
        limits: what one read may cost.
        at_a_time: how many files are read at the same time; more wait.
    """

    def __init__(self, limits: ReaderLimits | None = None, *, at_a_time: int = 4) -> None:
        self.limits = limits or ReaderLimits()
        self._places = threading.BoundedSemaphore(at_a_time)
        self._lock = threading.Lock()
        self._ready: _Process | None = None
        self._all: set[_Process] = set()
        self._stopped: OrderedDict[_FileState, str] = OrderedDict()

    def warm(self) -> None:
        """Have a process ready; returns at once, while it loads the readers."""
        with self._lock:
            if self._ready is not None and self._ready.ended:
                self._all.discard(self._ready)
                self._ready = None
            if self._ready is None:
                with suppress(OSError):  # the next read says so, if it is still so
                    self._ready = self._started()

    def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a reader process and return what it returns.

        Args:
            function: a function of a module; where it takes `report`, its progress counts as a sign of life.
            args: its arguments, of the types that `messages` can send; the first one names the file.
            kwargs: its options, likewise. A `report` is called in this thread, also while there is nothing new; where
                it raises, the process is stopped.

        Raises:
            LadarregError: what the function raises, of the same type and with the same text.
            FormatError: if the process crashed, hung, or needed more memory than it may.
        """
        report: Any = kwargs.pop("report", None)
        file = _FileState.of(function, args)
        self._refuse_again(file)
        request = {
            "module": function.__module__,
            "name": function.__qualname__,
            "args": list(args),
            "kwargs": dict(kwargs),
            "folder": _working_folder(),
            "memory_bytes": self.limits.memory_for(file.bytes),
            "silent_s": self.limits.silence_for(file.bytes),
        }
        with self._places:
            process = self._taken(file)
            sound = False
            try:
                answer = process.asked(request, self.limits, file, report)
                error = _error_in(answer, file)
                sound = not answer["worn"] and (error is None or isinstance(error, _HARMLESS))
            except _ReaderStoppedError as stopped:
                if stopped.by_the_file:
                    self._remember(file, str(stopped))
                raise FormatError(str(stopped)) from None
            finally:
                self._give_back(process, sound=sound)
        if error is not None:
            raise error
        return answer["answer"]  # type: ignore[no-any-return]

    def close(self) -> None:
        """Stop all processes; reads under way fail. It can be used again."""
        with self._lock:
            processes, self._ready = list(self._all), None
            self._all.clear()
        for process in processes:
            process.stop()

    def _started(self) -> _Process:
        process = _Process()
        self._all.add(process)
        return process

    def _taken(self, file: _FileState) -> _Process:
        with self._lock:
            process, self._ready = self._ready, None
            if process is not None and not process.ended:
                return process
            if process is not None:
                self._all.discard(process)  # somebody killed it
            try:
                return self._started()
            except OSError as error:
                reason = error.strerror or type(error).__name__
                text = f"{file.name}: it cannot be read now, as no process can be started ({reason}); try again"
                raise FormatError(text) from error

    def _give_back(self, process: _Process, *, sound: bool) -> None:
        """Keep a process for the next file, but not one that met a damaged file or grew large."""
        with self._lock:
            if sound and self._ready is None and not process.ended:
                self._ready = process
                return
        process.stop()
        with self._lock:
            self._all.discard(process)
        if not sound:
            self.warm()

    def _remember(self, file: _FileState, text: str) -> None:
        if not file.path:
            return
        with self._lock:
            self._stopped[file] = text
            while len(self._stopped) > _REMEMBERED:
                self._stopped.popitem(last=False)

    def _refuse_again(self, file: _FileState) -> None:
        """Refuse an unchanged file whose reader was stopped before: a page may ask for it again and again."""
        with self._lock:
            text = self._stopped.get(file)
        if text is not None:
            raise FormatError(text)


@dataclass(frozen=True, slots=True)
class _FileState:
    """The file that a call reads, as it is now."""

    name: str
    path: str
    function: str
    bytes: int
    changed_ns: int

    @staticmethod
    def of(function: Callable[..., Any], args: tuple[Any, ...]) -> _FileState:
        called = f"{function.__module__}.{function.__qualname__}"
        if not args or not isinstance(args[0], str | os.PathLike):  # not remembered: it has no state
            return _FileState(function.__qualname__, "", called, 0, 0)
        from ladarreg_core.formats.untrusted import shown_name

        path = os.path.abspath(os.fspath(args[0]))
        try:
            state = os.stat(path)
            size = state.st_size
            if path.lower().endswith(".json") and function.__name__ in _FOLLOWS_DESCRIPTORS:
                # It is small itself, but may stand for any of the files beside it.
                size = sum(entry.stat().st_size for entry in os.scandir(os.path.dirname(path)) if entry.is_file())
            return _FileState(shown_name(path), path, called, size, state.st_mtime_ns)
        except (OSError, ValueError):  # the reader says what is wrong with it
            return _FileState(shown_name(path), path, called, 0, 0)


class _ReaderStoppedError(Exception):
    """A reader process that ended, or had to be ended, before it answered."""

    def __init__(self, text: str, *, by_the_file: bool = True) -> None:
        super().__init__(text)
        self.by_the_file = by_the_file


class _Process:
    """One reader process."""

    def __init__(self) -> None:
        private = {name: value for name, value in os.environ.items() if not name.startswith("LADARREG_")}
        options: dict[str, Any] = {}
        if sys.platform == "win32":
            options["creationflags"] = subprocess.CREATE_NO_WINDOW
        else:
            options["start_new_session"] = True  # Ctrl-C is for the parent
        self._popen = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if log.isEnabledFor(logging.DEBUG) else subprocess.DEVNULL,
            # Thread pools of the numerical libraries take address space for each core of the machine.
            env={**private, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            **options,
        )
        if sys.platform == "linux":
            import fcntl

            assert self._popen.stdout is not None
            with suppress(OSError):  # more than a user may have; it is only faster
                fcntl.fcntl(self._popen.stdout.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    @property
    def ended(self) -> bool:
        """Whether it runs no more."""
        return self._popen.poll() is not None

    def asked(
        self, request: dict[str, Any], limits: ReaderLimits, file: _FileState, report: Report | None
    ) -> dict[str, Any]:
        """Return the answer to a request.

        Raises:
            _ReaderStoppedError: if there is none.
        """
        exchange = _Exchange(self._popen, request, limits.result_bytes)
        begun = heard = time.monotonic()
        signs = 0
        while not exchange.over(_TICK_S):
            now = time.monotonic()
            if exchange.signs != signs:
                signs, heard = exchange.signs, now
            patience = request["silent_s"] if signs else _START_S
            if now - heard > patience or now - begun > limits.longest_s:
                raise _ReaderStoppedError(_hung(file, now - begun))
            if report is not None:
                report(exchange.progress or Progress(0, 0, f"reading {file.name}"))
        if exchange.answer is not None:
            return exchange.answer
        if exchange.refused:
            log.debug("%s: %s", file.path, exchange.refused)
            raise _ReaderStoppedError(f"{file.name}: its reader sent no sensible answer; {_DAMAGED}")
        if exchange.unsent is not None:
            raise exchange.unsent
        raise self._why_it_ended(file, time.monotonic() - begun)

    def stop(self) -> None:
        """End it at once."""
        with suppress(OSError):
            self._popen.kill()
        self._popen.wait()
        for stream in (self._popen.stdin, self._popen.stdout):
            assert stream is not None
            with suppress(OSError):  # what could not be sent any more
                stream.close()

    def _why_it_ended(self, file: _FileState, seconds: float) -> _ReaderStoppedError:
        try:
            code = self._popen.wait(_END_S)
        except subprocess.TimeoutExpired:
            return _ReaderStoppedError(f"{file.name}: its reader ended without an answer; {_DAMAGED}")
        if code < 0:
            number = -code
            if number == getattr(signal, "SIGALRM", None):
                return _ReaderStoppedError(_hung(file, seconds))
            if number == getattr(signal, "SIGKILL", None):
                text = f"{file.name}: its reader was killed from outside, perhaps for want of memory; try again"
                return _ReaderStoppedError(text, by_the_file=False)
            words = signal.strsignal(number) or f"signal {number}"
            return _ReaderStoppedError(f"{file.name}: its reader crashed ({words}); {_DAMAGED}")
        return _ReaderStoppedError(f"{file.name}: its reader ended with code {code:#x} and no answer; {_DAMAGED}")


class _Exchange:
    """A request and the messages that come back, in a thread of their own: pipes know no time limit everywhere."""

    def __init__(self, popen: subprocess.Popen[bytes], request: dict[str, Any], result_bytes: int) -> None:
        self._popen, self._request, self._result_bytes = popen, request, result_bytes
        self._news = threading.Event()
        self._over = False
        self.signs = 0
        self.progress: Progress | None = None
        self.answer: dict[str, Any] | None = None
        self.refused: Exception | None = None
        self.unsent: TypeError | None = None
        threading.Thread(target=self._run, name="reader", daemon=True).start()

    def over(self, seconds: float) -> bool:
        """Wait for news; return whether there will be no more."""
        self._news.wait(seconds)
        self._news.clear()
        return self._over

    def _run(self) -> None:
        from ladarreg_core.formats.isolated.messages import MessageError

        try:
            self._exchange()
        except (EOFError, OSError):
            pass  # the process has ended, and its code says why
        except (MessageError, ValueError, TypeError, KeyError) as error:
            self.refused = error
        finally:
            self._over = True
            self._news.set()

    def _exchange(self) -> None:
        from ladarreg_core.formats.isolated.messages import MessageError, read_message, write_message
        from ladarreg_core.formats.untrusted import one_line

        requests, answers = self._popen.stdin, self._popen.stdout
        assert requests is not None
        assert answers is not None
        try:
            write_message(requests, self._request)
        except TypeError as error:  # the caller's, not the file's
            self.unsent = error
            return
        while True:
            message = read_message(answers, largest_bytes=self._result_bytes)
            if not isinstance(message, dict):
                raise MessageError(f"a {type(message).__name__} for an answer")
            if "progress" not in message:
                self.answer = message | {"worn": bool(message["worn"])}
                return
            if message["progress"] is not None:
                done, total, label = message["progress"]
                self.progress = Progress(int(done), int(total), one_line(label))
            self.signs += 1
            self._news.set()


def _working_folder() -> str:
    """Return the folder that relative paths start from; empty where somebody removed it."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def _hung(file: _FileState, seconds: float) -> str:
    return f"{file.name}: its reader was stopped, as it hung for {seconds:.0f} s; {_DAMAGED}"


def _error_in(answer: dict[str, Any], file: _FileState) -> LadarregError | None:
    """Return the error that a reader answered with; None where it answered with a result."""
    from ladarreg_core.formats.untrusted import one_line

    if "answer" in answer:
        return None
    if "memory" in answer:
        return FormatError(f"{file.name}: it needs more memory than a file of its size may; thin it out or split it")
    if "fault" in answer:
        log.error("the reader of %s failed: %s", file.path, str(answer.get("trace"))[-4000:])
        fault = one_line(answer["fault"], 60)
        return FormatError(f"{file.name}: its reader failed ({fault}); {_DAMAGED}")
    kind = getattr(errors, str(answer.get("error")), None)
    if not (isinstance(kind, type) and issubclass(kind, LadarregError)):
        kind = FormatError
    return kind(one_line(answer.get("text", "")))
