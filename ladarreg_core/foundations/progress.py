"""Progress reports of long-running work."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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


Report = Callable[[Progress], None]
"""Callback for `Progress`; raises `Cancelled` to stop the work."""


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
