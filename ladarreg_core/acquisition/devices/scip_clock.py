"""The clock of a SCIP 2 scanner: without the jumps at which it wraps, and compared with the host's; no I/O.

A time stamp has a checksum of six bits only. What it must fit besides: the time between the request for a line and its
arrival, and the regular turns of the mirror.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ladarreg_core.acquisition.devices.scip_protocol import CLOCK_MS, ScipError
from ladarreg_core.acquisition.interfaces import ClockReading

_MS = 0.001
_WRAP_S = CLOCK_MS * _MS
_STEP_S = 0.0005  # half of the clock's step
_DRIFT = 1e-3  # relative, more than any quartz
_SLACK_S = 0.005
_STAMP_S = 0.002
_UNEVEN = 0.1  # of a turn, between two lines
_FAST = 0.02  # relative, of the motor's speed


@dataclass(frozen=True, slots=True)
class ClockSample:
    """The scanner's clock as read once."""

    begun_s: float
    """Host time before it was asked, s."""
    ended_s: float
    """Host time after it had answered, s."""
    clock_ms: int

    @property
    def host_s(self) -> float:
        """Host time, s, most likely that of the reading."""
        return (self.begun_s + self.ended_s) / 2

    @property
    def uncertainty_s(self) -> float:
        """How far off that can be, with the clock's step, s."""
        return (self.ended_s - self.begun_s) / 2 + _STEP_S


class ScannerClock:
    """The scanner's clock as compared with the host's; `compare` comes first, and again after some time."""

    def __init__(self) -> None:
        self._reading: ClockReading | None = None
        self._host_s = 0.0

    @property
    def reading(self) -> ClockReading | None:
        """How the clocks related when they were compared last; None if they were not, or that no longer holds."""
        return self._reading

    def is_fresh(self, now_s: float, *, for_s: float) -> bool:
        """Return whether it was compared within a time, s."""
        return self._reading is not None and now_s - self._host_s <= for_s

    def forget(self) -> None:
        """Forget what it was compared with: the scanner may have been switched off, and has begun anew."""
        self._reading = None

    def compare(self, samples: Sequence[ClockSample]) -> ClockReading:
        """Return how the clocks relate, by the quickest of several samples.

        Raises:
            ScipError: if samples contradict each other, or the clock was set back since it was compared before.
        """
        best = min(samples, key=lambda sample: sample.uncertainty_s)
        time_s = best.clock_ms * _MS
        if self._reading is not None:
            expected = best.host_s - self._reading.host_minus_scanner_s
            time_s = _nearest(time_s, expected)
            if abs(time_s - expected) > self.tolerance_s(best.host_s) + best.uncertainty_s:
                self.forget()
                raise ScipError(
                    f"the line scanner's clock is {time_s - expected:+.2f} s off since it was last compared; it was "
                    "switched off and on, or a time stamp was damaged: check its power and the cable, and resume"
                )
        found = ClockReading(best.host_s - time_s, best.uncertainty_s)
        for sample in samples:
            other = sample.host_s - _nearest(sample.clock_ms * _MS, time_s)
            apart = abs(other - found.host_minus_scanner_s)
            if apart > sample.uncertainty_s + best.uncertainty_s + _SLACK_S:
                self.forget()
                raise ScipError(
                    f"the line scanner's clock differs by {apart:.2f} s between two readings, more than the time that "
                    "they took; check the cable"
                )
        self._reading, self._host_s = found, best.host_s
        return found

    def tolerance_s(self, host_s: float) -> float:
        """Return how far a time stamp may be off the host's clock at a time, s."""
        assert self._reading is not None
        return self._reading.uncertainty_s + _DRIFT * abs(host_s - self._host_s) + _SLACK_S

    def unwrapped(self, clock_ms: int, *, host_s: float) -> float:
        """Return a time stamp, which came at about a time of the host, without the jumps at which it wraps, s."""
        assert self._reading is not None
        return _nearest(clock_ms * _MS, host_s - self._reading.host_minus_scanner_s)

    def host_s(self, scanner_s: float) -> float:
        """Return the host's time of one of the scanner's, s."""
        assert self._reading is not None
        return scanner_s + self._reading.host_minus_scanner_s


class LineTimes:
    """The times of the lines of one request, each checked.

    Args:
        clock: compared with the host's.
        period_s: time of a turn.
        asked_s: host time just before the request was sent.
    """

    def __init__(self, clock: ScannerClock, *, period_s: float, asked_s: float) -> None:
        self._clock, self._period_s, self._asked_s = clock, period_s, asked_s
        self._times: list[float] = []
        self._turns = 0

    def accept(self, clock_ms: int, *, arrived_s: float) -> float:
        """Return the time of the next line by the scanner's clock without jumps, s.

        Raises:
            ScipError: if it was measured before it was asked for or after it arrived, or out of step with the turns.
        """
        time_s = self._clock.unwrapped(clock_ms, host_s=arrived_s)
        host_s, slack = self._clock.host_s(time_s), self._clock.tolerance_s(arrived_s)
        # A line may be that of the turn that was going on when it was asked for. The specification has the stamp at
        # step 0; firmware that has it at the end of the turn is let pass, too.
        early, late = self._asked_s - self._period_s - host_s, host_s - arrived_s
        if max(early, late) > slack:
            off = f"{early:.2f} s before it was asked for" if early > slack else f"{late:.2f} s after it arrived"
            raise ScipError(
                f"the line scanner's time stamp says that a line was measured {off}; check the cable, and that no "
                "other program uses the port"
            )
        if self._times:
            self._require_step(time_s)
        self._times.append(time_s)
        return time_s

    def repeats(self, clock_ms: int) -> bool:
        """Return whether a time stamp is that of the line before."""
        return bool(self._times) and clock_ms == round(self._times[-1] / _MS) % CLOCK_MS

    def _require_step(self, time_s: float) -> None:
        # A busy scanner leaves turns out without counting them as lines.
        step, since, period = time_s - self._times[-1], time_s - self._times[0], self._period_s
        turns, uneven = round(step / period), _STAMP_S + _UNEVEN * period
        all_turns = self._turns + turns
        if (
            turns < 1
            or abs(step - turns * period) > uneven + _FAST * (turns - 1) * period
            or abs(since - all_turns * period) > uneven + _FAST * all_turns * period
        ):
            raise ScipError(
                f"the line scanner's time stamps are {1000 * step:.0f} ms apart where {1000 * period:.0f} ms "
                "are due; check the cable, and switch the scanner off and on if its motor speed was changed"
            )
        self._turns = all_turns


def _nearest(time_s: float, expected_s: float) -> float:
    """Return a time of a clock that wraps nearest to an expected one."""
    return time_s + round((expected_s - time_s) / _WRAP_S) * _WRAP_S
