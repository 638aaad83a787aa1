"""The scanner's clock compared with the host's, and the times of lines, without any device."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.devices.scip_clock import ClockSample, LineTimes, ScannerClock
from ladarreg_core.acquisition.devices.scip_protocol import (
    CLOCK_MS,
    ScipError,
)


class TestClock:
    """Comparing clocks and the times of lines, without any device."""

    @staticmethod
    def compared(offset_ms: float, *, at_s: float = 100.0) -> ScannerClock:
        clock = ScannerClock()
        clock.compare([ClockSample(at_s, at_s + 0.002, int(offset_ms + (at_s + 0.001) * 1000) % CLOCK_MS)])
        return clock

    @staticmethod
    def times(clock: ScannerClock) -> LineTimes:
        return LineTimes(clock, period_s=0.025, asked_s=101.0)

    @given(st.integers(0, CLOCK_MS - 1), st.floats(0, 0.5))
    def test_lines_in_step_are_accepted_wherever_the_clock_wraps(self, offset_ms: int, waited_s: float) -> None:
        times = self.times(self.compared(offset_ms))
        found = []
        for k in range(30):
            begun = 101.0 + waited_s + k * 0.025
            stamp = int(offset_ms + begun * 1000) % CLOCK_MS
            found.append(times.accept(stamp, arrived_s=begun + 0.03 + (0.4 if k % 7 == 0 else 0)))
        np.testing.assert_allclose(np.diff(found), 0.025, atol=0.0011)

    @pytest.mark.parametrize("off_ms", [-300, -60, -8, 8, 60, 300, 1 << 20])
    def test_a_stamp_that_is_off_is_refused_and_poisons_nothing(self, off_ms: int) -> None:
        clock = self.compared(5000)
        first = self.times(clock)
        if abs(off_ms) > 20:  # the first line has no line before it, but the clock of the host
            with pytest.raises(ScipError, match=r"before it was asked for|after it arrived"):
                first.accept((5000 + 101_010 + off_ms) % CLOCK_MS, arrived_s=101.04)
        times = self.times(clock)
        times.accept(5000 + 101_010, arrived_s=101.04)
        with pytest.raises(ScipError, match=r"before it was|after it|ms apart"):
            times.accept((5000 + 101_035 + off_ms) % CLOCK_MS, arrived_s=101.065)
        again = self.times(clock)
        assert again.accept(5000 + 101_035, arrived_s=101.065) == pytest.approx(106.035)

    def test_turns_that_are_left_out_are_whole(self) -> None:
        times = self.times(self.compared(0))
        times.accept(101_010, arrived_s=101.04)
        assert times.accept(101_085, arrived_s=101.12) == pytest.approx(101.085)
        with pytest.raises(ScipError, match="38 ms apart"):
            times.accept(101_123, arrived_s=101.16)

    def test_steps_that_are_each_a_little_long_are_noticed(self) -> None:
        times = self.times(self.compared(0))

        def measure() -> None:
            for k in range(60):
                times.accept(101_010 + 27 * k, arrived_s=101.1 + 0.027 * k)

        with pytest.raises(ScipError, match="ms apart"):
            measure()

    def test_clocks_that_contradict_each_other(self) -> None:
        clock = self.compared(0)
        with pytest.raises(ScipError, match=r"differs by 0.50 s between two readings"):
            clock.compare([ClockSample(101, 101.002, 101_001), ClockSample(101.1, 101.103, 101_601)])
        clock = self.compared(0)
        with pytest.raises(ScipError, match="switched off and on"):
            clock.compare([ClockSample(160, 160.002, 17)])
        assert not clock.is_fresh(160, for_s=60)
        assert clock.compare([ClockSample(161, 161.002, 1017)]).host_minus_scanner_s == pytest.approx(159.984)
