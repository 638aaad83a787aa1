"""One thread that draws, a wish a layer: what is wished faster than it can be drawn is dropped but for the last."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)

_CLOSE_S = 10.0


class Wishes:
    """The newest wish of every layer, drawn one after the other in a thread of its own."""

    def __init__(self, name: str) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[str, tuple[float, float, Callable[[], None]]] = {}
        self._drawn_at: dict[str, float] = {}
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def wish(self, layer: str, draw: Callable[[], None], *, after_s: float = 0.0, every_s: float = 0.0) -> None:
        """Draw a layer soon; an earlier wish for it that still waits is forgotten.

        Args:
            layer: what is drawn.
            draw: how; what it raises is logged.
            after_s: not before so many seconds have passed.
            every_s: nor before so many have passed since the layer was last drawn.
        """
        with self._changed:
            if self._closed:
                return
            due = max(time.monotonic() + after_s, self._drawn_at.get(layer, 0.0) + every_s)
            self._waiting[layer] = (due, every_s, draw)
            self._changed.notify_all()

    def forget(self, layer: str) -> None:
        """Drop the wish for a layer, if one waits."""
        with self._changed:
            self._waiting.pop(layer, None)
            self._changed.notify_all()

    def settle(self, timeout_s: float) -> bool:
        """Wait until nothing is left to draw; return whether that was so in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting and not self._busy, timeout=timeout_s)

    def close(self) -> None:
        """End the thread; what still waits is not drawn."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=_CLOSE_S)

    def _work(self) -> None:
        while True:
            with self._changed:
                layer = self._next()
                while layer is None:
                    if self._closed:
                        return
                    self._changed.wait(timeout=self._pause())
                    layer = self._next()
                _, _, draw = self._waiting.pop(layer)
                self._busy = True
            try:
                draw()
            except Exception:
                # The thread outlives whatever one drawing meets; the next wish may be another matter.
                log.exception("the 3-D stage could not draw its %s", layer)
            with self._changed:
                now = self._drawn_at[layer] = time.monotonic()
                if layer in self._waiting:  # wished for while it was being drawn
                    due, every_s, draw = self._waiting[layer]
                    self._waiting[layer] = (max(due, now + every_s), every_s, draw)
                self._busy = False
                self._changed.notify_all()

    def _next(self) -> str | None:
        now = time.monotonic()
        return next((layer for layer, (due, _, _) in self._waiting.items() if due <= now), None)

    def _pause(self) -> float | None:
        if not self._waiting:
            return None
        return max(0.0, min(due for due, _, _ in self._waiting.values()) - time.monotonic())
