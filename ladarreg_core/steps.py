"""The log of a registration: times each step, keeps it, and tells whoever listens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.progress import Step, StepReport


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
