"""The log of a registration's steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches


@dataclass(frozen=True, slots=True)
class Step:
    """One finished step of a registration."""

    name: str
    """Name, e.g. `channels` or `climb`."""
    seconds: float
    """Wall time, s; NaN: it is kept elsewhere, see `Registration.untimed`."""
    matches: Matches | None = None
    """The matches after it, if it produced any."""
    pose: Rigid | None = None
    """`camera_from_scanner` after it, if there is one."""
    detail: Mapping[str, Any] = field(default_factory=dict)
    """Counts and figures, JSON-ready."""


StepReport = Callable[[Step], None]
"""Callback for `Step`s; raises `Cancelled` to stop the work."""


class StepLog:
    """Collects the `Step`s of a registration in order and reports each.

    The code of a step sets `matches` and `pose` while it runs; a pose is kept for the steps that follow.
    """

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
        """Time a step; the yielded dict becomes its detail."""
        detail: dict[str, Any] = {}
        self.matches = None
        started = time.perf_counter()
        yield detail
        step = Step(name, time.perf_counter() - started, self.matches, self.pose, detail)
        self._steps.append(step)
        if self._report is not None:
            self._report(step)
