"""The real clock and the simulated one keep the same promises; the simulated one takes no time for it."""

from __future__ import annotations

import threading

import pytest

from ladarreg_core.acquisition.clock import Clock, RealClock
from testing.devices.simulated_clock import SimulatedClock


@pytest.fixture(params=[RealClock, SimulatedClock])
def clock(request: pytest.FixtureRequest) -> Clock:
    return request.param()  # type: ignore[no-any-return]


def test_time_passes_by_waiting_and_threads_meet(clock: Clock) -> None:
    begun, event = clock.now(), threading.Event()
    clock.sleep(0.02)
    assert clock.now() >= begun + 0.02
    assert not clock.wait(event, 0.01)

    def work() -> None:
        clock.sleep(0.05)
        event.set()

    thread = threading.Thread(target=work)
    clock.start(thread)
    assert clock.wait(event, 30)
    clock.join(thread)
    assert not thread.is_alive()
    assert clock.now() >= begun + 0.08


def test_threads_of_a_simulated_clock_take_turns_in_the_order_of_time() -> None:
    clock, said = SimulatedClock(), []

    def say(name: str, every_s: float, times: int) -> threading.Thread:
        def work() -> None:
            for _ in range(times):
                clock.sleep(every_s)
                said.append((round(clock.now(), 6), name))

        thread = threading.Thread(target=work)
        clock.start(thread)
        return thread

    threads = [say("a", 1.0, 5), say("b", 1.4, 3)]
    clock.after(1.2, lambda: said.append((clock.now(), "action")))
    for thread in threads:
        clock.join(thread)
    assert said == sorted(said)
    assert len(said) == 9
    assert clock.now() == pytest.approx(5)
