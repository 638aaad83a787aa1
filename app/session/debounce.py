"""Debouncing of background work: it starts once requests pause."""

from __future__ import annotations

import threading
import time

_PAUSE_S, _LONGEST_DELAY_S = 0.12, 1.0


class Debouncer:
    """Wakes one thread after a burst of requests has ended, at the latest one second after it began.

    Expensive computations would otherwise slow down every edit of a burst.
    """

    def __init__(self) -> None:
        self._requested = threading.Event()
        self._closed = False

    @property
    def requested(self) -> bool:
        """Whether there was a request since the last wait ended."""
        return self._requested.is_set()

    def request(self) -> None:
        """Wake the thread soon."""
        self._requested.set()

    def close(self) -> None:
        """End the thread's loop."""
        self._closed = True
        self._requested.set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a request, and then until requests pause; False: closed.

        Args:
            timeout_s: the longest time to wait for a request; None: unlimited.
        """
        if not self._requested.wait(timeout_s):
            return not self._closed
        begun = time.monotonic()
        while not self._closed and time.monotonic() - begun < _LONGEST_DELAY_S:
            self._requested.clear()
            if not self._requested.wait(_PAUSE_S):
                break
        self._requested.clear()
        return not self._closed
