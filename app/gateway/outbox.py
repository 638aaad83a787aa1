"""What waits to be sent to one page: a slow one gets the newest state, not a longer queue."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from .protocol import Message

_MOST_EVENTS = 200
_NEWEST_WINS = frozenset({"simplex", "hover"})
"""Events of which only the last one says anything."""


class Outbox:
    """Messages to one page; filled from any thread, emptied by one task.

    Args:
        wake: called, from the thread that fills, when there is something after there was nothing.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = threading.Lock()
        self._slices: dict[str, Any] = {}
        self._rest_of_slices: dict[str, Any] = {}
        self._newest: dict[str, Message] = {}
        self._events: deque[Message] = deque(maxlen=_MOST_EVENTS)
        self._reply: str | None = None

    def put(self, message: Message) -> None:
        """Add slices, which replace those of the same name, or an event."""
        with self._lock:
            idle = self._is_empty()
            if "slices" in message:
                self._slices.update(message["slices"])
                self._rest_of_slices = {name: value for name, value in message.items() if name != "slices"}
            elif message.get("event") in _NEWEST_WINS:
                self._newest[message["event"]] = message
            else:
                self._events.append(message)
        if idle:
            self._wake()

    def reply(self, text: str) -> None:
        """Add the answer to the page's question; it goes out after what changed before it."""
        with self._lock:
            idle = self._is_empty()
            self._reply = text
        if idle:
            self._wake()

    def take(self) -> tuple[list[Message], str | None]:
        """Return all that waits, messages and the answer, and forget it."""
        with self._lock:
            messages = [{"slices": self._slices} | self._rest_of_slices] if self._slices else []
            messages += [*self._newest.values(), *self._events]
            reply, self._reply = self._reply, None
            self._slices, self._newest = {}, {}
            self._events.clear()
        return messages, reply

    def _is_empty(self) -> bool:
        return not (self._slices or self._newest or self._events or self._reply)
