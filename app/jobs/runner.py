"""The job runner: runs one job at a time, reports its progress, and lets clients pause or stop it."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from ladarreg_core.errors import Cancelled, LadarregError, OptionError
from ladarreg_core.progress import Progress, Step
from ladarreg_core.project.history import Author

from ..messages import internal_error, sentence

log = logging.getLogger(__name__)
State = Literal["running", "paused", "done", "failed", "stopped"]
Control = Literal["pause", "stop", "speed", "step"]
_PUBLISH_EVERY_S = 0.1
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
    state: State = "running"
    done: int = 0
    total: int = 0
    message: str = ""
    speed: float = FULL_SPEED
    steps: list[Step] = field(default_factory=list)
    begun: float = field(default_factory=time.monotonic)
    seconds: float = 0.0

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

    def end(self, state: State, message: str) -> None:
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
            self._stop.set()
            self._resumed.set()
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


class JobRunner:
    """Runs one job at a time."""

    def __init__(self, on_change: Callable[[Job], None]) -> None:
        self._on_change = on_change
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._context: JobContext | None = None
        self._thread: threading.Thread | None = None

    @property
    def job(self) -> Job | None:
        """The present job, or the last one."""
        return self._context.job if self._context else None

    @property
    def is_busy(self) -> bool:
        """Whether a job is running or paused."""
        job = self.job
        return job is not None and job.runs

    def start(
        self, kind: str, work: Work, *, label: str, photo: str, author: Author, can: tuple[Control, ...] = ("stop",),
        speed: float = FULL_SPEED,
    ) -> str:  # fmt: skip
        """Start a job; a running one of the same kind is stopped first.

        Returns:
            The job's id.

        Raises:
            OptionError: if a job of another kind is running.
        """
        with self._lock:
            if self.job is not None and self.job.runs:
                if self.job.kind != kind:
                    raise OptionError(f"'{self.job.label}' is running; wait until it ends, or stop it")
                self._end()
            job = Job(f"j{next(self._numbers)}", kind, label, photo, author, can, speed=speed)
            self._context = context = JobContext(job, lambda: self._on_change(job))
            self._thread = threading.Thread(target=self._run, args=(context, work), name=f"job {kind}", daemon=True)
            self._thread.start()
            return job.id

    def control(self, action: str, value: object = None) -> None:
        """Pause, resume, stop, step or change the speed of the present job.

        Raises:
            OptionError: if none is running, or it does not support that.
        """
        context = self._context
        if context is None:
            raise OptionError("no job is running")
        context.control(action, value)

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the present job has ended."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(seconds)

    def close(self) -> None:
        """Stop the job and wait for it."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._context is not None:
            self._context._stop.set()
            self._context._resumed.set()
        self.wait(30)

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
