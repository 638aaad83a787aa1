"""The time that drivers, runs and simulated devices live by: the real one, unless another one is given."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time and lets it pass.

    Whoever waits for a device does it here. Under a simulated clock, time passes only while all threads that live by it
    wait, so that seconds of a simulated device cost none.
    """

    def now(self) -> float:
        """Return the time, s, from any beginning; it never goes back."""

    def sleep(self, seconds: float) -> None:
        """Let some time pass, s."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until an event is set, at most some time, s; return whether it is."""

    def start(self, thread: threading.Thread) -> None:
        """Start a thread that lives by this clock."""

    def join(self, thread: threading.Thread) -> None:
        """Wait until a thread that this clock has started has ended."""


class RealClock:
    """The computer's own time (`time.monotonic`)."""

    def now(self) -> float:
        """Return the time, s."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Sleep, s."""
        time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until an event is set, at most some time, s; return whether it is."""
        return event.wait(seconds)

    def start(self, thread: threading.Thread) -> None:
        """Start a thread."""
        thread.start()

    def join(self, thread: threading.Thread) -> None:
        """Wait until a thread has ended."""
        thread.join()


REAL_CLOCK = RealClock()
"""Used wherever no other clock is given."""
