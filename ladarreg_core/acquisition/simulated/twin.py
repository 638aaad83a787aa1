"""What a simulated device is to the server that connects it with a port."""

from __future__ import annotations

import heapq
from typing import Protocol


class Twin(Protocol):
    """A simulated device; pure, with the time given."""

    name: str
    """Its name in addresses, e.g. `flir-ptu`."""
    baud: int
    """Bits a second of its port."""

    def feed(self, data: bytes, now_s: float) -> None:
        """Receive bytes from the host."""

    def due(self, now_s: float) -> bytes:
        """Return the bytes that it has sent by now, and forget them."""


class Outbox:
    """Bytes that a simulated device sends at given times, at the speed of its port.

    Args:
        baud: bits a second; ten make a byte.
    """

    def __init__(self, baud: int) -> None:
        self._byte_s = 10 / baud
        self._queue: list[tuple[float, int, bytes]] = []
        self._free_s = 0.0
        self._number = 0

    def send(self, data: bytes, at_s: float) -> float:
        """Send bytes not before a time and after those that were sent before; return when the last one arrives, s."""
        self._free_s = max(self._free_s, at_s) + len(data) * self._byte_s
        self._number += 1
        heapq.heappush(self._queue, (self._free_s, self._number, data))
        return self._free_s

    def due(self, now_s: float) -> bytes:
        """Return what has arrived by now."""
        out = b""
        while self._queue and self._queue[0][0] <= now_s:
            out += heapq.heappop(self._queue)[2]
        return out

    def clear(self) -> None:
        """Forget what has not been sent yet."""
        self._queue.clear()
        self._free_s = 0.0
