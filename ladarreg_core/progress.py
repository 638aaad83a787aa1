"""Progress reports of long-running work, and the log of a registration's steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Matches


_WHOLE = 1000  # steps of the progress of a whole whose parts report to it


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of loading, of an export or of a job."""

    done: int
    """Units done."""
    total: int
    """Total units; 0 if unknown."""
    label: str
    """The current activity, as shown to users."""


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


Report = Callable[[Progress], None]
"""Callback for `Progress`; raises `Cancelled` to stop the work."""
StepReport = Callable[[Step], None]
"""Callback for `Step`s; raises `Cancelled` to stop the work."""


def part_of(report: Report | None, first: float, last: float) -> Report | None:
    """Return a callback for the progress of a part of some work, reported as from `first` to `last` of the whole.

    Args:
        report: receives the progress of the whole.
        first: share of the whole that is done when the part begins.
        last: when it ends.
    """
    if report is None:
        return None

    def reported(progress: Progress) -> None:
        share = progress.done / progress.total if progress.total else 0.0
        report(Progress(round(_WHOLE * (first + (last - first) * min(share, 1.0))), _WHOLE, progress.label))

    return reported


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
