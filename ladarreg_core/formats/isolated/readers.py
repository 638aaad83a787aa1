"""Readers in separate processes: one that hangs, crashes or takes too much memory only fails its own file.

Scans and images go through native decoders, and a damaged or hostile file can crash the process in which they run.
`IsolatedReaders` runs any reader of `ladarreg_core.formats` (or any other importable function of paths and plain
values) in a child process with limits on memory and time, and returns its result:

    readers = IsolatedReaders()
    scan = readers.run(read_scan, path, scan_index=1)

The messages are defined in `messages`, the child's side in `worker`. This module imports nothing heavy, so that the
first child can start early.
"""

from __future__ import annotations

import io
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from ladarreg_core import errors
from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.foundations.progress import Progress, Report

P = ParamSpec("P")
T = TypeVar("T")

_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from ladarreg_core.formats.isolated.worker import main; main()"
_POLL_S = 0.25
_START_TIMEOUT_S = 60.0
_EXIT_TIMEOUT_S = 5.0
_PIPE_BYTES = 1 << 20
_DAMAGED = "the file is probably damaged: copy or export it again"
_READ_DESCRIPTORS = ("read_scan", "_read_files", "describe")
_MAX_REMEMBERED = 256
_LONGEST_KEY = 64

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderLimits:
    """Limits of one read."""

    memory_bytes: int = 1 << 30
    """Memory in addition to that of the idle process. Enforced on Linux; elsewhere only by the readers' own budget."""
    memory_per_file_byte: float = 96.0
    """Additional memory per byte of the file."""
    most_memory_bytes: int = 6 << 30
    """Upper bound of the memory, for any file."""
    silent_s: float = 30.0
    """Time without progress after which a reader is considered to hang."""
    silent_s_per_mb: float = 2.0
    """Additional time per megabyte of the file: not every reader reports progress."""
    most_silent_s: float = 300.0
    """Upper bound of the time without progress, for any file."""
    longest_s: float = 3600.0
    """Total time after which a reader is stopped."""
    result_bytes: int = 6 << 30
    """Size limit of a result."""

    def memory_for(self, file_bytes: int) -> int:
        """Return the memory limit for a file of a given size."""
        return int(min(self.memory_bytes + self.memory_per_file_byte * file_bytes, self.most_memory_bytes))

    def silence_for(self, file_bytes: int) -> float:
        """Return the longest time without progress for a file of a given size."""
        return min(self.silent_s + self.silent_s_per_mb * file_bytes / 2**20, max(self.silent_s, self.most_silent_s))


class IsolatedReaders:
    """Pool of reader processes: one is kept ready, more are started when several files are read at the same time.

    Args:
        limits: limits of one read.
        max_parallel: number of files that are read at the same time; further calls wait.
    """

    def __init__(self, limits: ReaderLimits | None = None, *, max_parallel: int = 4) -> None:
        self.limits = limits or ReaderLimits()
        self._slots = threading.BoundedSemaphore(max_parallel)
        self._lock = threading.Lock()
        self._ready: _Process | None = None
        self._processes: set[_Process] = set()
        self._failures: OrderedDict[FileState, str] = OrderedDict()
        self._origins = _KnownOrigins()

    def warm(self) -> None:
        """Start a process in advance; returns at once, while the process loads the readers."""
        with self._lock:
            if self._ready is not None and self._ready.ended:
                self._processes.discard(self._ready)
                self._ready = None
            if self._ready is None:
                with suppress(OSError):  # the next read reports it if it persists
                    self._ready = self._start()

    def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a reader process and return its result.

        Args:
            function: a module-level function; if it takes `report`, its progress counts as a sign of life.
            args: positional arguments, of types that `messages` can send; the first one is the file.
            kwargs: keyword arguments, likewise. `report` is called in this thread at regular intervals, even without
                news; if it raises, the process is stopped.

        Raises:
            LadarregError: as raised by the function, with the same type and text.
            FormatError: if the process crashed, hung, or exceeded its memory limit.
        """
        report: Any = kwargs.pop("report", None)
        file = FileState.of(function, args)
        self._refuse_known_failure(file)
        files = states_of([*args, *kwargs.values()])
        request = {
            "module": function.__module__,
            "name": function.__qualname__,
            "args": list(args),
            "kwargs": dict(kwargs),
            "folder": _working_folder(),
            "memory_bytes": self.limits.memory_for(file.bytes),
            "silent_s": self.limits.silence_for(file.bytes),
            "origins": self._origins.of(files),
        }
        with self._slots:
            process = self._take_process(file)
            reusable = False
            try:
                answer = process.ask(request, self.limits, file, report)
                error = error_in(answer, file)
                reusable = not answer["worn"]
                self._origins.learn(files, answer.get("origins"))
            except ReaderStoppedError as stopped:
                if stopped.caused_by_file:
                    self._remember(file, str(stopped))
                raise FormatError(str(stopped)) from None
            finally:
                self._return_process(process, reusable=reusable)
        if error is not None:
            raise error
        return answer["answer"]  # type: ignore[no-any-return]

    def close(self) -> None:
        """Stop all processes; running reads fail. The pool can be used again afterwards."""
        with self._lock:
            processes, self._ready = list(self._processes), None
            self._processes.clear()
        for process in processes:
            process.stop()

    def _start(self) -> _Process:
        process = _Process()
        self._processes.add(process)
        return process

    def _take_process(self, file: FileState) -> _Process:
        with self._lock:
            process, self._ready = self._ready, None
            if process is not None and not process.ended:
                return process
            if process is not None:
                self._processes.discard(process)  # it was killed from outside
            try:
                return self._start()
            except OSError as error:
                reason = error.strerror or type(error).__name__
                text = f"{file.name}: it cannot be read now because no process can be started ({reason}); try again"
                raise FormatError(text) from error

    def _return_process(self, process: _Process, *, reusable: bool) -> None:
        """Keep a process for the next file unless a file can have changed it."""
        with self._lock:
            if reusable and self._ready is None and not process.ended:
                self._ready = process
                return
        process.stop()
        with self._lock:
            self._processes.discard(process)
        if not reusable:
            self.warm()

    def _remember(self, file: FileState, text: str) -> None:
        if not file.path:
            return
        with self._lock:
            self._failures[file] = text
            while len(self._failures) > _MAX_REMEMBERED:
                self._failures.popitem(last=False)

    def _refuse_known_failure(self, file: FileState) -> None:
        """Refuse an unchanged file whose reader was stopped before: a page may request it repeatedly."""
        with self._lock:
            text = self._failures.get(file)
        if text is not None:
            raise FormatError(text)


@dataclass(frozen=True, slots=True)
class FileState:
    """Identity and current state of the file that a call reads."""

    name: str
    path: str
    function: str
    bytes: int
    changed_ns: int

    @staticmethod
    def of(function: Callable[..., Any], args: tuple[Any, ...]) -> FileState:
        """Return the state of the file that a call names first."""
        called = f"{function.__module__}.{function.__qualname__}"
        if not args or not isinstance(args[0], str | os.PathLike):  # without a path nothing is remembered
            return FileState(function.__qualname__, "", called, 0, 0)
        from ladarreg_core.formats.parsing.untrusted import shown_name

        path = os.path.abspath(os.fspath(args[0]))
        try:
            state = os.stat(path)
            size = state.st_size
            if path.lower().endswith(".json") and function.__name__ in _READ_DESCRIPTORS:
                # A descriptor is small, but may refer to any of the files beside it.
                size = sum(entry.stat().st_size for entry in os.scandir(os.path.dirname(path)) if entry.is_file())
            return FileState(shown_name(path), path, called, size, state.st_mtime_ns)
        except (OSError, ValueError):  # the reader reports what is wrong
            return FileState(shown_name(path), path, called, 0, 0)


def states_of(values: Iterable[Any]) -> frozenset[tuple[str, int, int]]:
    """Return path, size and time of change of all files among the arguments of a call."""
    found: set[tuple[str, int, int]] = set()
    for value in values:
        if isinstance(value, os.PathLike):
            with suppress(OSError, ValueError):
                state = os.stat(value)
                found.add((os.path.abspath(value), state.st_size, state.st_mtime_ns))
        elif isinstance(value, list | tuple):
            found |= states_of(value)
    return frozenset(found)


class _KnownOrigins:
    """Where the scanners of clouds stood, which takes long to find: for the next process that reads the same files.

    What was found while some files were read is only told where all of these are read again, so that no file can
    mislead the reader of another one.
    """

    def __init__(self) -> None:
        self._rows: OrderedDict[frozenset[tuple[str, int, int]], list[Any]] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, files: frozenset[tuple[str, int, int]]) -> list[Any]:
        with self._lock:
            return [row for known, rows in self._rows.items() if known <= files for row in rows]

    def learn(self, files: frozenset[tuple[str, int, int]], rows: Any) -> None:
        if not files or not isinstance(rows, list) or not 0 < len(rows) <= _MAX_REMEMBERED:
            return
        if not all(map(_is_origin, rows)):  # of a process that a file has taken over
            return
        with self._lock:
            self._rows[files] = rows
            self._rows.move_to_end(files)
            while len(self._rows) > _MAX_REMEMBERED:
                self._rows.popitem(last=False)


def _is_origin(row: Any) -> bool:
    """Return whether a value is a row of `kept_answers`."""
    if not isinstance(row, list) or len(row) != 5:
        return False
    key, position, *shares, may_be_centre = row
    numbers = [*shares, *(position if isinstance(position, list | tuple) and len(position) == 3 else ())]
    return (
        isinstance(key, str) and len(key) <= _LONGEST_KEY
        and (position is None or len(numbers) == len(shares) + 3)
        and all(isinstance(number, float) for number in numbers)
        and isinstance(may_be_centre, bool)
    )  # fmt: skip


class ReaderStoppedError(Exception):
    """A reader process ended, or had to be stopped, before it answered."""

    def __init__(self, text: str, *, caused_by_file: bool = True) -> None:
        super().__init__(text)
        self.caused_by_file = caused_by_file


class _Process:
    """One reader process."""

    def __init__(self) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("LADARREG_")}
        options: dict[str, Any] = {}
        if sys.platform == "win32":
            options["creationflags"] = subprocess.CREATE_NO_WINDOW
        else:
            options["start_new_session"] = True  # Ctrl-C must reach the parent only
        self._popen = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if log.isEnabledFor(logging.DEBUG) else subprocess.DEVNULL,
            # Thread pools of the numerical libraries reserve address space for every core.
            env={**environment, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            **options,
        )
        if sys.platform == "linux":
            import fcntl

            assert self._popen.stdout is not None
            with suppress(OSError):  # beyond the user's limit; a larger pipe is only faster
                fcntl.fcntl(self._popen.stdout.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._popen.poll() is not None

    def ask(
        self, request: dict[str, Any], limits: ReaderLimits, file: FileState, report: Report | None
    ) -> dict[str, Any]:
        """Send a request and return the answer.

        Raises:
            ReaderStoppedError: if the process ends or has to be stopped before it answers.
        """
        exchange = _Exchange(self._popen, request, limits.result_bytes)
        started = last_sign = time.monotonic()
        signs = 0
        while not exchange.over(_POLL_S):
            now = time.monotonic()
            if exchange.signs != signs:
                signs, last_sign = exchange.signs, now
            timeout = request["silent_s"] if signs else _START_TIMEOUT_S
            if now - last_sign > timeout or now - started > limits.longest_s:
                raise ReaderStoppedError(_hung(file, now - started))
            if report is not None:
                report(exchange.progress or Progress(0, 0, f"reading {file.name}"))
        if exchange.answer is not None:
            return exchange.answer
        if exchange.refused:
            log.debug("%s: %s", file.path, exchange.refused)
            raise ReaderStoppedError(str(invalid_answer(file)))
        if exchange.unsent is not None:
            raise exchange.unsent
        raise self._why_it_ended(file, time.monotonic() - started)

    def stop(self) -> None:
        """Kill the process."""
        with suppress(OSError):
            self._popen.kill()
        self._popen.wait()
        for stream in (self._popen.stdin, self._popen.stdout):
            assert stream is not None
            with suppress(OSError):  # data that could not be sent
                stream.close()

    def _why_it_ended(self, file: FileState, seconds: float) -> ReaderStoppedError:
        try:
            return why_it_ended(file, self._popen.wait(_EXIT_TIMEOUT_S), seconds)
        except subprocess.TimeoutExpired:
            return ReaderStoppedError(f"{file.name}: its reader ended without an answer; {_DAMAGED}")


class _Exchange:
    """A request and its replies, handled in a separate thread because pipes have no timeouts on some systems."""

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
        """Wait for news; return whether the exchange has ended."""
        self._news.wait(seconds)
        self._news.clear()
        return self._over

    def _run(self) -> None:
        from ladarreg_core.formats.isolated.messages import MessageError

        try:
            self._exchange()
        except (EOFError, OSError):
            pass  # the process has ended, and its exit code says why
        except (MessageError, ValueError, TypeError, KeyError) as error:
            self.refused = error
        finally:
            self._over = True
            self._news.set()

    def _exchange(self) -> None:
        from ladarreg_core.formats.isolated.messages import MessageError, read_message, write_message
        from ladarreg_core.formats.isolated.pieces import Turn
        from ladarreg_core.formats.parsing.untrusted import one_line

        requests = self._popen.stdin
        assert requests is not None
        assert self._popen.stdout is not None
        answers = io.BufferedReader(Turn(self._popen.stdout), _PIPE_BYTES)
        try:
            write_message(requests, self._request)
        except TypeError as error:  # the caller's mistake, not the file's
            self.unsent = error
            return
        while True:
            message = read_message(answers, largest_bytes=self._result_bytes)
            if not isinstance(message, dict):
                raise MessageError(f"the answer is a {type(message).__name__}")
            if "progress" not in message:
                worn = bool(message["worn"])
                if answers.read(1):  # nothing follows an answer, and the process that sent it has ended
                    raise MessageError("the answer is followed by more")
                self.answer = message | {"worn": worn}
                return
            if message["progress"] is not None:
                done, total, label = message["progress"]
                self.progress = Progress(int(done), int(total), one_line(label))
            self.signs += 1
            self._news.set()


def _working_folder() -> str:
    """Return the current working folder; empty if it has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def invalid_answer(file: FileState) -> FormatError:
    """Return the error of a reader process that does not keep to the protocol."""
    return FormatError(f"{file.name}: its reader sent an invalid answer; {_DAMAGED}")


def why_it_ended(file: FileState, code: int, seconds: float) -> ReaderStoppedError:
    """Return why a reader process ended that has not answered.

    Args:
        file: what it read.
        code: exit code, or less than 0: the signal that ended it.
        seconds: since it began.
    """
    if code >= 0:
        return ReaderStoppedError(f"{file.name}: its reader ended with code {code:#x} and no answer; {_DAMAGED}")
    number = -code
    if number == getattr(signal, "SIGALRM", None):
        return ReaderStoppedError(_hung(file, seconds))
    if number == getattr(signal, "SIGKILL", None):
        text = f"{file.name}: its reader was killed from outside, perhaps because memory ran out; try again"
        return ReaderStoppedError(text, caused_by_file=False)
    name = signal.strsignal(number) or f"signal {number}"
    return ReaderStoppedError(f"{file.name}: its reader crashed ({name}); {_DAMAGED}")


def _hung(file: FileState, seconds: float) -> str:
    return f"{file.name}: its reader hung and was stopped after {seconds:.0f} s; {_DAMAGED}"


def error_in(answer: dict[str, Any], file: FileState) -> LadarregError | None:
    """Return the error in an answer; None where it contains a result."""
    from ladarreg_core.formats.parsing.untrusted import one_line

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
