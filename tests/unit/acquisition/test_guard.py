"""When the guard takes a program for dead, by a simulated clock; `test_link.py` has guards in real processes."""

from __future__ import annotations

from io import BytesIO

import pytest

from ladarreg_core.acquisition.devices.guard import LONGEST_SILENCE_S, Guard
from testing.devices.simulated_clock import SimulatedClock


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def guard(clock: SimulatedClock) -> Guard:
    return Guard(BytesIO(), BytesIO(), clock=clock)


def beat(guard: Guard, clock: SimulatedClock, *, until_s: float) -> None:
    """Have the program give signs of life, ten a second."""
    guard.frames += 1
    if clock.now() < until_s:
        clock.after(0.1, lambda: beat(guard, clock, until_s=until_s))


def test_a_program_that_falls_silent_is_taken_for_dead_soon(guard: Guard, clock: SimulatedClock) -> None:
    beat(guard, clock, until_s=3.0)
    guard.await_silence()
    assert 3.0 + LONGEST_SILENCE_S <= clock.now() < 3.2 + LONGEST_SILENCE_S


def test_a_pause_of_the_whole_machine_is_no_silence(guard: Guard, clock: SimulatedClock) -> None:
    beat(guard, clock, until_s=100.0)
    clock.after(1.02, lambda: clock.jump(60))
    guard.await_silence()
    assert clock.now() >= 100 + LONGEST_SILENCE_S


def test_what_a_pause_counts_is_bounded(guard: Guard, clock: SimulatedClock) -> None:
    clock.after(0.3, lambda: clock.jump(60))
    guard.await_silence()
    assert 60.4 < clock.now() < 60 + LONGEST_SILENCE_S


def test_a_signal_ends_it_at_once(guard: Guard, clock: SimulatedClock) -> None:
    def end() -> None:
        guard.told_to_end = True

    beat(guard, clock, until_s=5.0)
    clock.after(1.0, end)
    guard.await_silence()
    assert clock.now() < 1.1
