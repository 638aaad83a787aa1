"""What long work tells while it runs: one stream for the command line, the benchmarks and the workbench."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Matches


@dataclass(frozen=True, slots=True)
class Progress:
    """How far loading, an export or a job has come."""

    done: int
    """Units finished."""
    total: int
    """Units in all; 0 where that is not known."""
    label: str
    """What is being done, for a person."""


@dataclass(frozen=True, slots=True)
class Step:
    """One finished step of a registration."""

    name: str
    """The step's name, e.g. `channels` or `climb`."""
    seconds: float
    """Wall time that it took."""
    matches: Matches | None = None
    """The matches as they stood after it, where it made any."""
    pose: Rigid | None = None
    """`camera_from_scanner` after it, where it had one."""
    detail: Mapping[str, Any] = field(default_factory=dict)
    """Counts and figures of the step, JSON-ready."""


Report = Callable[[Progress], None]
"""Receives `Progress`; raises `Cancelled` to stop the work."""
StepReport = Callable[[Step], None]
"""Receives `Step`s; raises `Cancelled` to stop the work."""


class StepLog:
    """Collects `Step`s in order; what a step found is set on the log while the step runs."""

    def __init__(self, report: StepReport | None = None) -> None:
        self._report = report
        self._steps: list[Step] = []
        self.matches: Matches | None = None
        self.pose: Rigid | None = None

    @property
    def steps(self) -> tuple[Step, ...]:
        """All finished steps."""
        return tuple(self._steps)

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Time a step; what is put into the yielded dict becomes its detail."""
        detail: dict[str, Any] = {}
        self.matches = None
        started = time.perf_counter()
        yield detail
        step = Step(name, time.perf_counter() - started, self.matches, self.pose, detail)
        self._steps.append(step)
        if self._report is not None:
            self._report(step)
