"""Work that can wait until nobody is in the middle of something."""

from __future__ import annotations

import threading
import time

_QUIET_S, _AT_MOST_S = 0.12, 1.0


class Quiet:
    """Lets one thread sleep until it is asked, and then for as long as it is asked again and again, a second at most.

    Whoever draws goes on undisturbed so: what takes time to compute would slow every one of his edits.
    """

    def __init__(self) -> None:
        self._asked = threading.Event()
        self._closed = False

    @property
    def asked(self) -> bool:
        """Whether somebody has asked since the last wait ended."""
        return self._asked.is_set()

    def ask(self) -> None:
        """Have the thread wake, soon."""
        self._asked.set()

    def close(self) -> None:
        """Have the thread end."""
        self._closed = True
        self._asked.set()

    def wait(self, at_most_s: float | None = None) -> bool:
        """Return after somebody has asked and nobody did since for a moment; False: it is over.

        Args:
            at_most_s: return after so long even if nobody asks; None: never.
        """
        if not self._asked.wait(at_most_s):
            return not self._closed
        begun = time.monotonic()
        while not self._closed and time.monotonic() - begun < _AT_MOST_S:
            self._asked.clear()
            if not self._asked.wait(_QUIET_S):
                break
        self._asked.clear()
        return not self._closed
