"""A clock on which only waiting takes time, the same on an idle machine and on a busy one."""

from __future__ import annotations

import heapq
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

TICK_S = 0.002
"""How often conditions are looked at, as the server of simulated devices does."""
_STUCK_S = 60.0  # real time; a thread that does not live by the clock holds the others up


@dataclass(frozen=True, slots=True)
class _Wait:
    until_s: float
    ready: Callable[[], bool]


class SimulatedClock:
    """A `Clock` by which one thread runs at a time; when it waits, time goes on to what happens next.

    Threads begin with `start`; the thread that makes the clock lives by it from the beginning.
    """

    def __init__(self) -> None:
        self._now = 0.0
        self._turn = threading.Condition()  # re-entrant: what happens at a time may look at the clock
        self._runs: threading.Thread | None = threading.current_thread()
        self._waiting: dict[threading.Thread, _Wait] = {}
        self._ended: set[threading.Thread] = set()
        self._actions: list[tuple[float, int, Callable[[], object]]] = []
        self._every_tick: list[Callable[[], object]] = []
        self._number = 0

    # -- as a `Clock` ------------------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the time, s."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let time pass, s."""
        self.wait_until(lambda: False, seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until an event is set, at most some time, s; return whether it is."""
        return self.wait_until(event.is_set, seconds)

    def start(self, thread: threading.Thread) -> None:
        """Start a thread; it begins to run when this one waits."""
        run = thread.run

        def live() -> None:
            self._await_turn()
            try:
                run()
            finally:
                with self._turn:
                    self._ended.add(thread)
                    self._hand_over()

        thread.run = live  # type: ignore[method-assign]
        with self._turn:
            self._waiting[thread] = _Wait(self._now, lambda: True)
        thread.start()

    def join(self, thread: threading.Thread) -> None:
        """Wait until a thread has ended."""
        self.wait_until(lambda: thread in self._ended, math.inf)
        thread.join()

    # -- for tests ---------------------------------------------------------------------------------------------

    def wait_until(self, ready: Callable[[], bool], seconds: float) -> bool:
        """Wait until something is so, at most some time, s; return whether it is."""
        with self._turn:
            me = threading.current_thread()
            self._waiting[me] = _Wait(self._now + seconds, ready)
            if self._runs is me:
                self._hand_over()
        self._await_turn()
        return ready()

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        """Have something happen some time from now, s, whoever waits then; it may not wait itself."""
        self._number += 1
        heapq.heappush(self._actions, (self._now + seconds, self._number, action))

    def when(self, ready: Callable[[], bool], action: Callable[[], object]) -> None:
        """Have something happen once something is so; it may not wait itself."""

        def look() -> None:
            if ready():
                self._every_tick.remove(look)
                action()

        self._every_tick.append(look)

    def every_tick(self, action: Callable[[], object]) -> None:
        """Have something happen each time that the clock moves, at least every `TICK_S`; it may not wait itself."""
        self._every_tick.append(action)

    def jump(self, seconds: float) -> None:
        """Let time pass during which nobody has run, s: as while the whole machine was asleep."""
        self._now += seconds

    # -- whose turn it is --------------------------------------------------------------------------------------

    def _await_turn(self) -> None:
        with self._turn:
            if not self._turn.wait_for(lambda: self._runs is threading.current_thread(), _STUCK_S):
                raise AssertionError(f"{self._runs} runs without waiting by the simulated clock")

    def _hand_over(self) -> None:
        """Give the turn to the thread whose wait ends first, moving the time there."""
        self._runs = None
        while self._waiting:
            chosen = next((thread for thread, wait in self._waiting.items() if self._is_over(wait)), None)
            if chosen is not None:
                del self._waiting[chosen]
                self._runs = chosen
                self._turn.notify_all()
                return
            self._move()

    def _is_over(self, wait: _Wait) -> bool:
        return wait.ready() or wait.until_s <= self._now

    def _move(self) -> None:
        ends = [wait.until_s for wait in self._waiting.values()]
        self._now = min(self._now + TICK_S, *ends, *(at_s for at_s, _, _ in self._actions[:1]))
        while self._actions and self._actions[0][0] <= self._now:
            heapq.heappop(self._actions)[2]()
        for action in tuple(self._every_tick):
            action()
