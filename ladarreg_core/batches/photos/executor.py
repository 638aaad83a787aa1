"""An executor of processes in which a process that dies costs nothing but time: its task is done again by another.

`concurrent.futures.ProcessPoolExecutor` gives up all tasks when a process is killed, and does not say which it was.
Here every process has a pipe of its own and one task at a time, so that whose task was lost is known. Another process
takes its place and does the task again; a task that has lost three processes fails, and the others go on. Processes are
spawned, never forked: the same on all systems, and safe beside threads. Each imports once and works with one thread.
Anything that takes a `concurrent.futures.Executor` can use it.

A task that itself asks for processes, as a survey of a batch does, gets none: its tasks are done in its own process.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import IO, Any, ParamSpec, TypeVar

from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.validation import require_int

P = ParamSpec("P")
T = TypeVar("T")

_MAX_PROCESSES = 256
MAX_ATTEMPTS = 3
"""A task that has lost so many processes is to blame itself."""
_MAX_STARTS = 10  # processes that end before they have begun a task: it is not to blame, but there has to be an end
_BEGUN = b"!"
_JOIN_S = 10.0
_START_AGAIN_S = 2.0
_MAX_WORDS = 300  # the last ones that a process wrote
_WORDS_BYTES = 4096
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

log = logging.getLogger(__name__)


class WorkerLostError(LadarregError):
    """Each process that was given a task ended before it had finished it."""


class WorkerProcesses(Executor):
    """Processes that work on tasks, one each at a time; use it in a `with` statement.

    At the end of the statement all tasks are waited for. If an exception leaves it, as of Ctrl-C, the processes are
    killed at once and no task is begun any more; nothing of them is left.

    Args:
        count: number of processes; None: one for each processor core that this process may use.
        attempts: a task that has lost so many processes fails.

    Raises:
        OptionError: if the count is not a number from 1 to 256.
    """

    def __init__(self, count: int | None = None, *, attempts: int = MAX_ATTEMPTS) -> None:
        self._attempts = attempts
        self.count = require_int(usable_cores() if count is None else count, "processes", least=1, most=_MAX_PROCESSES)
        self._tasks: deque[_Task] = deque()
        self._lock = threading.Lock()
        self._waker, self._woken = get_context("spawn").Pipe()
        self._is_woken = self._closed = self._killed = False
        self._dispatcher: threading.Thread | None = None
        self.remark = ""
        """Why no task is being done, a sentence; empty: it is."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Have a function called in one of the processes.

        Args:
            fn: a function of a module; it, its arguments and its result are pickled.
            args: positional arguments.
            kwargs: keyword arguments.

        Returns:
            Its future, which raises what the function raised, or `WorkerLostError` if it has lost too many processes.

        Raises:
            RuntimeError: after `shutdown`.
        """
        future: Future[T] = Future()
        if _is_worker and not self._closed:
            _do_here(future, fn, args, kwargs)
            return future
        with self._lock:
            if self._closed:
                raise RuntimeError("no task can be submitted after the processes were shut down")
            self._tasks.append(_Task(future, fn, args, kwargs))
            if self._dispatcher is None:
                self._dispatcher = threading.Thread(target=self._dispatch, name="worker processes", daemon=True)
                self._dispatcher.start()
            self._wake()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes when they have worked off their tasks.

        Args:
            wait: return only then.
            cancel_futures: begin none of the tasks that wait.
        """
        with self._lock:
            self._closed = True
            for task in self._tasks if cancel_futures else ():
                task.future.cancel()
            self._wake()
        if wait and self._dispatcher is not None:
            self._dispatcher.join()

    def kill(self) -> None:
        """End the processes at once, whatever they do, and cancel all tasks."""
        self._killed = True
        self.shutdown(cancel_futures=True)

    def __exit__(self, kind: type[BaseException] | None, error: object, at: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill()

    def _wake(self) -> None:
        """Have the dispatcher look at the tasks; to be called with the lock."""
        if not self._is_woken:
            self._is_woken = True
            self._waker.send_bytes(b"!")

    def _dispatch(self) -> None:
        """Hand out tasks and take in results until all is done; in a thread of its own."""
        workers: list[_Worker] = []
        try:
            while not self._killed:
                if not self._hand_out(workers):
                    time.sleep(_START_AGAIN_S)
                    continue
                busy = {worker.connection: worker for worker in workers if worker.task is not None}
                with self._lock:
                    if not busy and not self._tasks and self._closed:
                        return
                for ready in wait([self._woken, *busy]):
                    if ready is self._woken:
                        with self._lock:
                            self._woken.recv_bytes()
                            self._is_woken = False
                    elif not (worker := busy[ready]).finish():  # type: ignore[index]
                        self._replace(worker, workers)
        except Exception as error:  # as if no process can be started
            log.debug("the worker processes ended: %s", traceback.format_exc())
            with self._lock:
                self._closed = True
                for task in self._tasks:
                    if task.future.set_running_or_notify_cancel():
                        task.future.set_exception(error)
        finally:
            for worker in workers:
                worker.end()

    def _hand_out(self, workers: list[_Worker]) -> bool:
        """Give every free process a task, and start processes while there are tasks left; False: there are none."""
        while self._tasks:
            free = next((worker for worker in workers if worker.task is None), None)
            if free is None and len(workers) >= self.count:
                break
            if free is None:
                try:
                    free = _Worker()
                except OSError as error:  # too many processes or too little memory, for now
                    reason = (error.strerror or type(error).__name__).lower()
                    self.remark = f"no process can be started ({reason}); waiting until one can"
                    log.warning("%s", self.remark)
                    return bool(workers)
                self.remark = ""
                workers.append(free)
            with self._lock:
                task = self._tasks.popleft()
            is_again = task.attempts or task.starts_lost
            if (is_again or task.future.set_running_or_notify_cancel()) and not free.begin(task):
                self._replace(free, workers)
        return True

    def _replace(self, worker: _Worker, workers: list[_Worker]) -> None:
        """Give up a process that has ended, and put its task first in the queue unless it has lost too many."""
        workers.remove(worker)
        task, why = worker.lost()
        if task.attempts < self._attempts and task.starts_lost < _MAX_STARTS and not self._killed:
            log.warning("a task is tried again: %s", why)
            with self._lock:
                self._tasks.appendleft(task)
        else:
            task.future.set_exception(WorkerLostError(why))


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(slots=True, eq=False)
class _Task:
    future: Future[Any]
    function: Callable[..., Any]
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    attempts: int = 0
    """How often a process has begun it."""
    starts_lost: int = 0
    """How many processes ended before they had begun it, as while they were started."""


class _Worker:
    """One process, as its parent sees it."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.task: _Task | None = None
        self._has_begun = False
        descriptor, self._words_file = tempfile.mkstemp(prefix="ladarreg-worker-")
        self._words = os.fdopen(descriptor, "rb")
        self._process: SpawnProcess = context.Process(
            target=_serve, args=(theirs, os.getpid(), self._words_file), name="ladarreg worker", daemon=True
        )
        try:
            with _environment(dict.fromkeys(_ONE_THREAD, "1")):
                _block_interrupts()
                self._process.start()
        except BaseException:
            self._close()
            raise
        finally:
            theirs.close()

    def begin(self, task: _Task) -> bool:
        """Send a task; False: the process has ended."""
        self.task, self._has_begun = task, False
        try:
            message = pickle.dumps((task.function, task.args, task.kwargs))
        except Exception as error:  # whatever cannot be pickled; the process is as good as before
            self.task = None
            task.future.set_exception(error)
            return True
        try:
            self.connection.send_bytes(message)
        except OSError:
            return False
        return True

    def finish(self) -> bool:
        """Take in what the process sent: that it has begun, or a result; return whether it is still there."""
        try:
            message = self.connection.recv_bytes()
        except (EOFError, OSError):
            return False
        assert self.task is not None
        if message == _BEGUN:
            self._has_begun = True
            self.task.attempts += 1
            return True
        future, self.task = self.task.future, None
        try:
            value, error = pickle.loads(message)  # of a process of this program
        except Exception as failure:
            value, error = None, failure
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)
        return True

    def end(self) -> None:
        """Kill the process: it has nothing to do, or is not to do it."""
        self._process.kill()
        self._process.join(_JOIN_S)
        self._close()
        if self.task is not None:
            self.task.future.set_exception(WorkerLostError("the work was cancelled"))

    def lost(self) -> tuple[_Task, str]:
        """Return the task of a process that has ended, and why it did."""
        self._process.join(_JOIN_S)
        code, words = self._process.exitcode, _last_words(self._words)
        self._close()
        assert self.task is not None
        if not self._has_begun:
            self.task.starts_lost += 1
        why = _why_it_ended(code, max(1, self.task.attempts if self._has_begun else self.task.starts_lost))
        return self.task, f"{why}; its last words: {words}" if words else why

    def _close(self) -> None:
        self.connection.close()
        self._words.close()
        with contextlib.suppress(OSError):
            os.unlink(self._words_file)


def _why_it_ended(code: int | None, attempts: int) -> str:
    times = "" if attempts == 1 else f" {attempts} times"
    if code is not None and code < 0:
        name = signal.strsignal(-code) or f"signal {-code}"
        if -code == getattr(signal, "SIGKILL", None):
            return (
                f"its process was killed{times} ({name}), perhaps because memory ran out; run again, with fewer "
                "processes at a time"
            )
        return f"its process crashed{times} ({name}); run again, and report it if that repeats"
    return f"its process ended{times} with code {code} before it had finished; run again, and report it if that repeats"


def _block_interrupts() -> None:
    """Block Ctrl-C in this thread and in the processes that it starts: it is for the main thread alone."""
    if sys.platform != "win32":
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()  # which unblocks it, but only once
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_is_worker = False
"""Whether this process is one of several that work on tasks."""


@contextlib.contextmanager
def as_worker() -> Iterator[None]:
    """Work as one of several processes: with one thread, confined readers, and no processes of its own."""
    global _is_worker
    from threadpoolctl import threadpool_limits

    from ladarreg_core.formats.isolated.forked import confined_reads
    from ladarreg_core.foundations.parallel import one_thread

    before, _is_worker = _is_worker, True
    try:
        with one_thread(), threadpool_limits(1), confined_reads():
            yield
    finally:
        _is_worker = before


def _do_here(future: Future[Any], function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Do a task in this process, which is a worker itself."""
    try:
        future.set_result(function(*args, **kwargs))
    except Exception as error:
        future.set_exception(error)


def _last_words(stream: IO[bytes]) -> str:
    """Return the end of what a process wrote on stderr, on one line."""
    try:
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - _WORDS_BYTES))
        text = stream.read(_WORDS_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= _MAX_WORDS else f"... {words[-_MAX_WORDS:]}"


def _keep_words(file: str) -> bool:
    """Have what this process and its libraries write on stderr kept in a file, a crash's stack among it.

    Returns:
        Whether it is. The parent has the file open, so that its name is not needed any more: a killed program leaves
        none behind.
    """
    import faulthandler

    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_APPEND)
        os.dup2(descriptor, 2)
        os.close(descriptor)
    except OSError:  # there are no words then
        return False
    with contextlib.suppress(OSError):
        os.unlink(file)
    with contextlib.suppress(Exception):
        faulthandler.enable(2, all_threads=False)
    return True


def _forget_words() -> None:
    """Keep of what was written only what the next task writes."""
    with contextlib.suppress(OSError, ValueError):
        os.ftruncate(2, 0)


def _serve(connection: Connection, parent: int, words: str) -> None:
    """Work off the tasks of the parent, one after the other, until it closes the pipe or ends."""
    from ladarreg_core.formats.isolated.worker import end_with

    are_kept = _keep_words(words)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where signals cannot be blocked
    if sys.platform == "linux":  # elsewhere it ends after its task
        end_with(parent)
    with as_worker():
        while True:
            try:
                function, args, kwargs = pickle.loads(connection.recv_bytes())
            except (EOFError, OSError):
                return
            if are_kept:
                _forget_words()
            connection.send_bytes(_BEGUN)
            connection.send_bytes(_answer(function, args, kwargs))


def _answer(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> bytes:
    try:
        return pickle.dumps((function(*args, **kwargs), None))
    except Exception as error:
        log.debug("a task failed: %s", traceback.format_exc())
        try:
            answer = pickle.dumps((None, error))
            pickle.loads(answer)  # some exceptions can be written and not read
        except Exception:
            return pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer
