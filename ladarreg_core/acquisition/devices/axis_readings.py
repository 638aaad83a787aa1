"""Positions of an axis, read from a unit whose answers have no checksum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.flir_protocol import FlirError

_FASTER, _SPARE_COUNTS, _STILL_COUNTS = 1.5, 10, 1


@dataclass(frozen=True, slots=True)
class _Reading:
    counts: int
    begun_s: float
    ended_s: float


class AxisReadings:
    """Reads an axis, and once more where no movement explains what it says.

    Args:
        query: the query for its position, for messages.
        read: asks for the position and returns the counts.
        limits: lowest and highest counts.
        clock: what the time between readings is measured by.
    """

    def __init__(
        self, query: str, read: Callable[[], int], *, limits: tuple[int, int], clock: Clock = REAL_CLOCK
    ) -> None:
        self._query, self._ask, self._limits, self._clock = query, read, limits, clock
        self._last: _Reading | None = None
        self._still = False

    def forget(self) -> None:
        """Forget where it was: it may have been reset."""
        self._last, self._still = None, False

    def may_move(self) -> None:
        """Say that it is about to be told to move."""
        self._still = False

    def position(self, fastest_counts_s: float) -> int:
        """Return where it is, counts.

        Args:
            fastest_counts_s: the highest speed that it may have, counts/s.

        Raises:
            FlirError: if two readings contradict each other.
        """
        last, found, still = self._last, self._read(), self._still
        low, high = self._limits
        within = low - _SPARE_COUNTS <= found.counts <= high + _SPARE_COUNTS
        before = last
        if last is None or not within or not _follows(last, found, fastest_counts_s, still=still):
            before, found = found, self._read()  # it may have been pushed, or reset: then both readings agree
            if not _follows(before, found, fastest_counts_s) and (
                last is None or not _follows(last, found, fastest_counts_s, still=still)
            ):
                raise FlirError(
                    f"the pan/tilt unit answered {before.counts} to {self._query} and {found.counts} when it was asked "
                    "again; check the cable, and that no other program uses the port"
                )
        self._last, self._still = found, before is not None and before.counts == found.counts
        return found.counts

    def _read(self) -> _Reading:
        begun = self._clock.now()
        return _Reading(self._ask(), begun, self._clock.now())


def _follows(before: _Reading, found: _Reading, fastest_counts_s: float, *, still: bool = False) -> bool:
    """Return whether an axis can have moved from one reading to another; `still` if it was not told to."""
    way = abs(found.counts - before.counts)
    if still:
        return way <= _STILL_COUNTS
    return way <= _FASTER * fastest_counts_s * (found.ended_s - before.begun_s) + _SPARE_COUNTS
