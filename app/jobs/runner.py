"""The one worker: runs a job, tells how far it is, and lets anybody pause or stop it."""

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

log = logging.getLogger(__name__)
State = Literal["running", "paused", "done", "failed", "stopped"]
Control = Literal["pause", "stop", "speed", "step"]
_TOLD_EVERY_S = 0.1
FULL_SPEED = 0.0
"""Iterations a second: as many as there can be."""


@dataclass(slots=True)
class Job:
    """What is being done, as everybody may read it."""

    id: str
    kind: str
    label: str
    photo: str
    author: str
    can: tuple[Control, ...] = ()
    state: State = "running"
    done: int = 0
    total: int = 0
    said: str = ""
    speed: float = FULL_SPEED
    steps: list[Step] = field(default_factory=list)
    begun: float = field(default_factory=time.monotonic)
    seconds: float = 0.0

    @property
    def runs(self) -> bool:
        """Whether it is not over."""
        return self.state in ("running", "paused")


class JobContext:
    """What a job's work has in its hands."""

    def __init__(self, job: Job, tell: Callable[[], None]) -> None:
        self.job = job
        self._tell = tell
        self._told = 0.0
        self._stop = threading.Event()
        self._go = threading.Event()
        self._go.set()
        self._single_steps = 0

    @property
    def stop_wanted(self) -> bool:
        """Whether somebody stopped it; work that has something to keep looks here, all other calls `check`."""
        return self._stop.is_set()

    @property
    def speed(self) -> float:
        """Iterations a second that the operator wants to see; 0: no limit."""
        return self.job.speed

    def check(self) -> None:
        """Wait while the job is paused.

        Raises:
            Cancelled: if somebody stopped it.
        """
        self.wait_while_paused()
        if self._stop.is_set():
            raise Cancelled("stopped")

    def wait_while_paused(self) -> None:
        """Wait until somebody lets it go on, asks for a single step, or stops it."""
        while not self._go.is_set() and not self._stop.is_set():
            if self._single_steps > 0:
                self._single_steps -= 1
                return
            self._go.wait(0.05)

    def sleep(self, seconds: float) -> None:
        """Wait, but not longer than until it is stopped."""
        self._stop.wait(seconds)

    def step(self, step: Step) -> None:
        """Tell a finished step; as `check`."""
        self.job.steps.append(step)
        self.tell(now=True)
        self.check()

    def progress(self, progress: Progress) -> None:
        """Tell how far it is; as `check`."""
        self.job.done, self.job.total, self.job.said = progress.done, progress.total, progress.label
        self.tell()
        self.check()

    def tell(self, *, now: bool = False) -> None:
        """Have the state told, but not too often."""
        clock = time.monotonic()
        if now or clock - self._told >= _TOLD_EVERY_S:
            self._told = clock
            self.job.seconds = clock - self.job.begun
            self._tell()

    def control(self, action: str, value: object) -> None:
        """Do what somebody asks of the job.

        Raises:
            OptionError: if the job cannot.
        """
        can = {"resume": "pause"}.get(action, action)
        if can not in self.job.can:
            raise OptionError(f"'{self.job.label}' cannot be told to {action}")
        if action == "speed":
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e6:
                raise OptionError("the speed is a number of iterations a second; 0 means no limit")
            self.job.speed = float(value)
        elif action == "stop":
            self._stop.set()
            self._go.set()
        elif action == "pause":
            self._go.clear()
            self.job.state = "paused"
        elif action == "resume":
            self._go.set()
            self.job.state = "running"
        elif action == "step":
            self._go.clear()
            self.job.state = "paused"
            self._single_steps += 1
        self.tell(now=True)


Work = Callable[[JobContext], str]
"""Does a job and returns a sentence on how it ended."""


class JobRunner:
    """Runs one job at a time."""

    def __init__(self, tell: Callable[[Job], None]) -> None:
        self._tell = tell
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._context: JobContext | None = None
        self._thread: threading.Thread | None = None

    @property
    def job(self) -> Job | None:
        """The present job, or the last one."""
        return self._context.job if self._context else None

    def start(
        self, kind: str, work: Work, *, label: str, photo: str, author: str, can: tuple[Control, ...] = ("stop",),
        speed: float = FULL_SPEED,
    ) -> str:  # fmt: skip
        """Begin a job; one of the same kind that still runs is stopped for it.

        Returns:
            Its id.

        Raises:
            OptionError: if another kind of job runs.
        """
        with self._lock:
            if self.job is not None and self.job.runs:
                if self.job.kind != kind:
                    raise OptionError(f"'{self.job.label}' is running; wait until it ends, or stop it")
                self._end()
            job = Job(f"j{next(self._numbers)}", kind, label, photo, author, can, speed=speed)
            self._context = context = JobContext(job, lambda: self._tell(job))
            self._thread = threading.Thread(target=self._run, args=(context, work), name=f"job {kind}", daemon=True)
            self._thread.start()
            return job.id

    def control(self, action: str, value: object = None) -> None:
        """Pause, resume, stop, step or slow down the job.

        Raises:
            OptionError: if none runs, or it cannot.
        """
        context = self._context
        if context is None or not context.job.runs:
            raise OptionError("nothing is running")
        context.control(action, value)

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the present job is over."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(seconds)

    def close(self) -> None:
        """Stop the job and wait for it."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._context is not None:
            self._context._stop.set()
            self._context._go.set()
        self.wait(30)

    def _run(self, context: JobContext, work: Work) -> None:
        job = context.job
        context.tell(now=True)
        try:
            job.said = work(context)
            job.state = "stopped" if context.stop_wanted else "done"
        except Cancelled:
            job.state, job.said = "stopped", "Stopped; nothing was changed."
        except LadarregError as error:
            job.state, job.said = "failed", _sentence(str(error))
        except MemoryError:
            job.state, job.said = "failed", "There is not enough memory for it; take a smaller scan or photograph."
        except Exception as error:
            log.exception("job %s", job.kind)
            job.state = "failed"
            job.said = f"This is a fault of the program ({type(error).__name__}: {error}); nothing was changed."
        context.tell(now=True)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")
