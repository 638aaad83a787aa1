"""A drawing thread with one pending request per layer: requests that come faster than it draws replace each other."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)

_CLOSE_TIMEOUT_S = 10.0


class DrawQueue:
    """The latest request of every layer, drawn one at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        self._condition = threading.Condition()
        self._pending: dict[str, tuple[float, float, Callable[[], None]]] = {}
        self._drawn_at: dict[str, float] = {}
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def request(self, layer: str, draw: Callable[[], None], *, after_s: float = 0.0, every_s: float = 0.0) -> None:
        """Draw a layer soon; replaces its pending request.

        Args:
            layer: name of the layer.
            draw: draws it; exceptions are logged.
            after_s: delay before it is drawn, s.
            every_s: minimum time since the layer was last drawn, s.
        """
        with self._condition:
            if self._closed:
                return
            due = max(time.monotonic() + after_s, self._drawn_at.get(layer, 0.0) + every_s)
            self._pending[layer] = (due, every_s, draw)
            self._condition.notify_all()

    def cancel(self, layer: str) -> None:
        """Drop the pending request of a layer, if there is one."""
        with self._condition:
            self._pending.pop(layer, None)
            self._condition.notify_all()

    def settle(self, timeout_s: float) -> bool:
        """Wait until nothing is left to draw; return False on timeout."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._pending and not self._busy, timeout=timeout_s)

    def close(self) -> None:
        """End the thread; pending requests are dropped."""
        with self._condition:
            self._closed = True
            self._pending.clear()
            self._condition.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=_CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        while True:
            with self._condition:
                layer = self._next_due()
                while layer is None:
                    if self._closed:
                        return
                    self._condition.wait(timeout=self._time_to_next_s())
                    layer = self._next_due()
                _, _, draw = self._pending.pop(layer)
                self._busy = True
            try:
                draw()
            except Exception:
                # One failed drawing must not end the thread.
                log.exception("the 3-D scene could not draw its %s", layer)
            with self._condition:
                now = self._drawn_at[layer] = time.monotonic()
                if layer in self._pending:  # requested while it was being drawn
                    due, every_s, draw = self._pending[layer]
                    self._pending[layer] = (max(due, now + every_s), every_s, draw)
                self._busy = False
                self._condition.notify_all()

    def _next_due(self) -> str | None:
        now = time.monotonic()
        return next((layer for layer, (due, _, _) in self._pending.items() if due <= now), None)

    def _time_to_next_s(self) -> float | None:
        if not self._pending:
            return None
        return max(0.0, min(due for due, _, _ in self._pending.values()) - time.monotonic())
