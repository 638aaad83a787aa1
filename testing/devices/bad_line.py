"""A line between a computer and a device that delays, echoes, flips bits or loses bytes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from ladarreg_core.acquisition.simulated.twin import Twin


class BadLine:
    """A simulated device at the far end of a bad line; itself a `Twin`.

    Args:
        twin: the device.
        delay_s: time that bytes take, each way, as through a serial server.
        echo: send back what is received, as a two-wire converter does.
    """

    def __init__(self, twin: Twin, *, delay_s: float = 0.0, echo: bool = False) -> None:
        self.twin, self.name, self.baud = twin, twin.name, twin.baud
        self.delay_s, self.echo = delay_s, echo
        self.damage: Callable[[bytes], bytes] | None = None
        """What happens to the next bytes from the device; once."""
        self.damaged = 0
        """How often that has happened."""
        self._there: deque[tuple[float, bytes]] = deque()
        self._back: deque[tuple[float, bytes]] = deque()

    def feed(self, data: bytes, now_s: float) -> None:
        """Receive bytes from the host."""
        self._there.append((now_s + self.delay_s, data))
        if self.echo:
            self._back.append((now_s, data))

    def due(self, now_s: float) -> bytes:
        """Return the bytes that have come by now, and forget them."""
        while self._there and self._there[0][0] <= now_s:
            at_s, data = self._there.popleft()
            self.twin.feed(data, at_s)
        if came := self.twin.due(now_s):
            if self.damage is not None:
                came, self.damage = self.damage(came), None
                self.damaged += 1
            self._back.append((now_s + self.delay_s, came))
        out = b""
        while self._back and self._back[0][0] <= now_s:
            out += self._back.popleft()[1]
        return out


def flip(data: bytes) -> bytes:
    """Flip a bit in the middle."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :]


def lose(data: bytes) -> bytes:
    """Lose everything."""
    return b""
