"""The job runner: runs one job after the other, reports their progress, and lets clients pause or stop them."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ladarreg_core.errors import Cancelled, LadarregError, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.project.history import Author
from ladarreg_core.results.steps import Step

from ..messages import internal_error, sentence

if TYPE_CHECKING:
    from ..slices.choices import Control, JobState

log = logging.getLogger(__name__)
_PUBLISH_EVERY_S = 0.1
_STOPS_WITHIN_S = 30.0
_MAX_WAITING = 50
FULL_SPEED = 0.0
"""Speed without limit, in place of iterations per second; also in the protocol."""
WATCHED_SPEED = 60.0
"""Initial speed of a simplex, iterations per second: slow enough to be followed by eye."""


@dataclass(slots=True)
class Job:
    """State of a job."""

    id: str
    kind: str
    label: str
    photo: str
    author: Author
    can: tuple[Control, ...] = ()
    state: JobState = "waiting"
    done: int = 0
    total: int = 0
    message: str = ""
    speed: float = FULL_SPEED
    steps: list[Step] = field(default_factory=list)
    begun: float = field(default_factory=time.monotonic)
    seconds: float = 0.0
    waited: bool = False
    """Whether it did not begin at once, so that its inputs may have changed since it was started."""

    @property
    def runs(self) -> bool:
        """Whether the job is running or paused."""
        return self.state in ("running", "paused")


class JobContext:
    """A running job's connection to the runner: progress, pause and stop."""

    def __init__(self, job: Job, publish: Callable[[], None]) -> None:
        self.job = job
        self._publish = publish
        self._published_at = 0.0
        self._stop = threading.Event()
        self._resumed = threading.Event()
        self._resumed.set()
        self._single_steps = 0
        self._changing = threading.Lock()

    @property
    def stop_wanted(self) -> bool:
        """Whether a stop was requested; for work with a partial result to keep, all other work calls `check`."""
        return self._stop.is_set()

    @property
    def speed(self) -> float:
        """Iterations per second, or `FULL_SPEED`."""
        return self.job.speed

    def check(self) -> None:
        """Wait while the job is paused.

        Raises:
            Cancelled: if a stop was requested.
        """
        self.wait_while_paused()
        if self._stop.is_set():
            raise Cancelled("stopped")

    def wait_while_paused(self) -> None:
        """Wait until the job is resumed, stepped or stopped."""
        while not self._resumed.is_set() and not self._stop.is_set():
            if self._single_steps > 0:
                self._single_steps -= 1
                return
            self._resumed.wait(0.05)

    def sleep(self, seconds: float) -> None:
        """Wait, at most until a stop is requested."""
        self._stop.wait(seconds)

    def step(self, step: Step) -> None:
        """Report a finished step; raises as `check`."""
        self.job.steps.append(step)
        self.publish(now=True)
        self.check()

    def progress(self, progress: Progress) -> None:
        """Report progress; raises as `check`."""
        self.job.done, self.job.total, self.job.message = progress.done, progress.total, progress.label
        self.publish()
        self.check()

    def publish(self, *, now: bool = False) -> None:
        """Publish the job's state, at a limited rate unless `now`."""
        clock = time.monotonic()
        if now or clock - self._published_at >= _PUBLISH_EVERY_S:
            self._published_at = clock
            self.job.seconds = clock - self.job.begun
            self._publish()

    def control(self, action: str, value: object) -> None:
        """Pause, resume, stop, step or change the speed of the job.

        Raises:
            OptionError: if the job does not support it, or has ended.
        """
        with self._changing:  # a job that has just ended would stay paused
            if not self.job.runs:
                raise OptionError("no job is running")
            self._control(action, value)
        self.publish(now=True)

    def request_stop(self) -> None:
        """Let the job end as soon as it looks, also while it is paused."""
        self._stop.set()
        self._resumed.set()

    def end(self, state: JobState, message: str) -> None:
        """Record how the job ended, which no later control changes."""
        with self._changing:
            self.job.message, self.job.state = message, state
        self.publish(now=True)

    def _control(self, action: str, value: object) -> None:
        can = {"resume": "pause"}.get(action, action)
        if can not in self.job.can:
            raise OptionError(f"'{self.job.label}' does not support {action!r}")
        if action == "speed":
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e6:
                raise OptionError("the speed is a number of iterations per second; 0 means full speed")
            self.job.speed = float(value)
        elif action == "stop":
            self.request_stop()
        elif action == "pause":
            self._resumed.clear()
            self.job.state = "paused"
        elif action == "resume":
            self._resumed.set()
            self.job.state = "running"
        elif action == "step":
            self._resumed.clear()
            self.job.state = "paused"
            self._single_steps += 1


Work = Callable[[JobContext], str]
"""Does the work of a job and returns a sentence on the result."""


@dataclass(slots=True)
class _Entry:
    """A job with its work."""

    context: JobContext
    work: Work

    @property
    def job(self) -> Job:
        return self.context.job


class JobRunner:
    """Runs one job at a time, in the order in which they were started.

    Args:
        on_change: called with a job whenever its state changes.
    """

    def __init__(self, on_change: Callable[[Job], None]) -> None:
        self._on_change = on_change
        self._numbers = itertools.count(1)
        self._changed = threading.Condition()
        self._context: JobContext | None = None
        self._waiting: list[_Entry] = []
        self._thread: threading.Thread | None = None  # while a job runs

    @property
    def job(self) -> Job | None:
        """The present job, or the last one."""
        return self._context.job if self._context else None

    @property
    def waiting(self) -> list[Job]:
        """The jobs that wait for it, in their order."""
        with self._changed:
            return [entry.job for entry in self._waiting]

    @property
    def is_busy(self) -> bool:
        """Whether a job is running, paused or waiting."""
        return self._thread is not None

    def start(
        self, kind: str, work: Work, *, label: str, photo: str, author: Author, can: tuple[Control, ...] = ("stop",),
        speed: float = FULL_SPEED,
    ) -> str:  # fmt: skip
        """Start a job, after those that were started before.

        One of the same kind on the same photograph is replaced: stopped if it is running, else never begun.

        Returns:
            The job's id.

        Raises:
            OptionError: if too many jobs are waiting.
        """
        job = Job(f"j{next(self._numbers)}", kind, label, photo, author, can, speed=speed)
        entry = _Entry(JobContext(job, lambda: self._on_change(job)), work)
        with self._changed:
            alike = [k for k, each in enumerate(self._waiting) if (each.job.kind, each.job.photo) == (kind, photo)]
            replaced = [self._waiting.pop(k).job for k in reversed(alike)]
            at = alike[0] if alike else len(self._waiting)
            present = self._context if self._thread is not None else None
            if present is not None and (present.job.kind, present.job.photo) == (kind, photo):
                present.request_stop()
                at = 0
            if at >= _MAX_WAITING:
                raise OptionError(f"{_MAX_WAITING} jobs are waiting; let some of them end first")
            self._waiting.insert(at, entry)
            job.waited = self._thread is not None
            if not job.waited:
                self._begin_next()
            elif at == 0 and present is not None and present.stop_wanted:
                self._changed.wait_for(lambda: job.state != "waiting", _STOPS_WITHIN_S)
        for each in replaced:
            self._drop(each)
        if job.state == "waiting":
            self._on_change(job)
        return job.id

    def control(self, action: str, value: object = None, *, job: str | None = None) -> None:
        """Pause, resume, stop, step or change the speed of the present job, or stop one that waits.

        Args:
            action: what to do.
            value: of `speed`.
            job: id of the job that is meant; None: the present one.

        Raises:
            OptionError: if none is running, it has ended meanwhile, or it does not support that.
        """
        with self._changed:
            found = next((entry for entry in self._waiting if entry.job.id == job), None)
            if found is not None and action == "stop":
                self._waiting.remove(found)
            context = self._context
        if found is not None:
            if action != "stop":
                raise OptionError(f"'{found.job.label}' has not begun; it can only be stopped")
            return self._drop(found.job)
        if context is None or (job is not None and context.job.id != job):
            raise OptionError("no job is running" if context is None else "this job has ended")
        return context.control(action, value)

    def wait(self, seconds: float | None = None) -> None:
        """Wait until all jobs have ended."""
        if threading.current_thread() is not self._thread:
            with self._changed:
                self._changed.wait_for(lambda: self._thread is None, seconds)

    def close(self) -> None:
        """Stop all jobs and wait for the present one."""
        with self._changed:
            dropped = [entry.job for entry in self._waiting]
            self._waiting.clear()
            if self._context is not None:
                self._context.request_stop()
        for job in dropped:
            self._drop(job)
        self.wait(_STOPS_WITHIN_S)

    def _drop(self, job: Job) -> None:
        """Say that a job will never begin."""
        job.state, job.message = "stopped", "Not begun."
        self._on_change(job)

    def _begin_next(self) -> None:
        """Begin the job that waits first; the lock is held."""
        if not self._waiting:
            self._thread = None
        else:
            entry = self._waiting.pop(0)
            entry.job.state, entry.job.begun = "running", time.monotonic()
            self._context = entry.context
            self._thread = threading.Thread(target=self._work, args=(entry,), name=f"job {entry.job.kind}", daemon=True)
            self._thread.start()
        self._changed.notify_all()

    def _work(self, entry: _Entry) -> None:
        try:
            self._run(entry.context, entry.work)
        finally:
            with self._changed:
                self._begin_next()

    def _run(self, context: JobContext, work: Work) -> None:
        job = context.job
        context.publish(now=True)
        try:
            message = work(context)
            context.end("stopped" if context.stop_wanted else "done", message)
        except Cancelled:
            context.end("stopped", "Stopped; nothing was changed.")
        except LadarregError as error:
            context.end("failed", sentence(str(error)))
        except MemoryError:
            context.end("failed", "Not enough memory; use a smaller scan or photograph.")
        except Exception as error:
            log.exception("job %s", job.kind)
            context.end("failed", internal_error(error, go_on="nothing was changed, try again"))
