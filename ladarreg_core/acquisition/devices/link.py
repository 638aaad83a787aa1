"""The link to a device: one exchange at a time, each with a deadline, all of them remembered for messages."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.ports import GuardEndedError
from ladarreg_core.acquisition.interfaces import Check
from ladarreg_core.acquisition.serial_port import Port, PortLostError
from ladarreg_core.errors import DeviceError, DeviceGlitchError

Complete = Callable[[bytes], bool | int]
"""Given the bytes so far: False while the reply is incomplete, else its length, or True if it is all of them."""
TRIES = 3
"""How often a command is sent, in all, whose answers are damaged or missing."""
QUIET_FIRST_S = 0.6
"""How long a device must be quiet before it is asked something, while it is not known how far away it is."""
_LOG = logging.getLogger(__name__)
_T = TypeVar("_T")
_MAX_ASKED = 4  # times, for two answers in a row that are the same
_QUIET_TRIPS = 1.5  # round trips after which no late answer is expected
_FORGOTTEN = 0.8  # of the longest round trip, what remains of it after the next one
_SLICE_S = 0.02
_REMEMBERED = 64  # exchanges
_QUOTED = 3  # exchanges in a message
_QUOTED_BYTES = 60
_KEPT_BYTES = 4096
_RECONNECT_S = 2.0
_RETRY_S = 0.2
_NAP_S = 0.02
_LONGEST_DRAIN_S = 0.2
_LONGEST_REPLY = 1 << 20  # bytes


class NoAnswerError(DeviceGlitchError):
    """A device gave no complete answer in time; the port is still there, and what reads only may be asked again."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """What was sent and received."""

    at_s: float
    """Host time of sending, s, by the clock of the link."""
    request: bytes
    """What was sent; empty for what came unasked."""
    reply: bytes
    """What came back before the exchange ended."""
    seconds: float
    """How long it took."""
    remark: str = ""
    """What a driver made of the exchanges before; nothing was sent or received then."""

    def __str__(self) -> str:
        sent = f"sent {_quoted(self.request)}" if self.request else "unasked"
        got = f"received {_quoted(self.reply)}" if self.reply else "received nothing"
        return f"{sent}, {got} in {self.seconds:.2f} s"


class RoundTrip:
    """How long a device takes to answer: a longer time counts at once, and is forgotten slowly."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        """0 while it is not known."""

    def took(self, seconds: float) -> None:
        """Count an exchange."""
        self.longest_s = max(_FORGOTTEN * self.longest_s, seconds)

    def quiet_s(self, least_s: float) -> float:
        """Return how long a device must be quiet, at least so long, until nothing is under way any more."""
        return max(least_s, _QUIET_TRIPS * self.longest_s)


class Link:
    """Exchanges requests and replies with a device.

    Args:
        port: the open port.
        device: the device, for messages, as in `the pan/tilt unit`.
        clock: what deadlines and the times of exchanges are measured by.
    """

    def __init__(self, port: Port, *, device: str, clock: Clock = REAL_CLOCK) -> None:
        self.device, self.clock = device, clock
        self._port = port
        self._connected: Callable[[], object] | None = None
        self._one = threading.RLock()
        self._buffer = bytearray()
        self._exchanges: deque[Exchange] = deque(maxlen=_REMEMBERED)
        self._log: Callable[[str, Exchange], None] | None = None
        self._reconnecting = False
        self._guard_reported = False
        self._closed = False
        self._unasked = b""

    def when_connected(self, set_up: Callable[[], object]) -> None:
        """Call `set_up` after the port was lost and opened again, to set the device up as before."""
        self._connected = set_up

    def log_to(self, log: Callable[[str, Exchange], None]) -> None:
        """Give each exchange to `log` from now on, with the device's name; those that are remembered at once."""
        for each in self.exchanges:
            log(self.device, each)
        self._log = log

    def remark(self, text: str) -> None:
        """Add a remark to the log."""
        self._add(Exchange(self.clock.now(), b"", b"", 0.0, text))

    @property
    def address(self) -> str:
        """Where the port leads."""
        return self._port.address

    @property
    def exchanges(self) -> tuple[Exchange, ...]:
        """The latest exchanges, oldest first."""
        return tuple(self._exchanges.copy())

    def exchange(
        self, request: bytes, *, complete: Complete, deadline_s: float, check: Check | None = None, fresh: bool = True
    ) -> bytes:
        """Send a request and return the reply to it; after a reconnection the request is sent once more.

        Args:
            request: the request; empty to go on receiving.
            complete: finds the end of the reply.
            deadline_s: from now, s.
            check: called at least every 50 ms; may raise `Cancelled`.
            fresh: drop what has come before; False keeps it as the beginning of the reply.

        Raises:
            NoAnswerError: if no complete reply comes in time.
            DeviceError: if the port is lost and cannot be opened again.
        """
        with self._one:
            try:
                return self._exchange(request, complete, deadline_s, check, fresh=fresh)
            except PortLostError as error:
                if self._reconnecting or self._closed or self._is_news_of_guard(error):
                    raise
                self._reconnect(error, check)
                return self._exchange(request, complete, deadline_s, check, fresh=True)

    def retried(
        self,
        ask: Callable[[], _T],
        *,
        unless: type[DeviceGlitchError] | tuple[()] = (),
        settle: Callable[[], object] | None = None,
    ) -> _T:
        """Return what `ask` returns, which is called again if no answer comes or a damaged one, `TRIES` times in all.

        Args:
            ask: exchanges that may be repeated.
            unless: what asking again does not mend; it is raised at once. By default, nothing.
            settle: called before each repetition.
        """
        for _ in range(TRIES - 1):
            try:
                return ask()
            except unless:
                raise
            except DeviceGlitchError as error:
                _LOG.info("asked again: %s", error)
                self.remark(f"asked again: {error}")
                if settle is not None:
                    settle()
        return ask()

    def receive(self, *, complete: Complete, deadline_s: float, check: Check | None = None) -> bytes:
        """Return the next reply of a device that goes on sending; without reconnection, since it would be in doubt.

        Raises:
            DeviceError: if no complete reply comes in time, or the port is lost.
        """
        with self._one:
            return self._exchange(b"", complete, deadline_s, check, fresh=False)

    def require_present(self) -> None:
        """Look whether the port is still there, without an exchange; does nothing while one is going on.

        Raises:
            DeviceError: if it is lost. The next exchange tries to open it again.
        """
        if not self._one.acquire(blocking=False):
            return
        try:
            self._buffer += self._port.read(0)
            del self._buffer[:-_LONGEST_REPLY]
        except GuardEndedError:
            self._guard_reported = True
            raise
        finally:
            self._one.release()

    def urgent(self, data: bytes) -> None:
        """Send bytes at once, whatever exchange is going on; its reply is left to that exchange.

        Raises:
            DeviceError: if the port is lost.
        """
        self._port.write(data)
        self._add(Exchange(self.clock.now(), data, b"", 0.0))

    def take_unasked(self) -> bytes:
        """Return what came unasked since the last call, as far as an exchange has dropped it."""
        with self._one:
            unasked, self._unasked = self._unasked, b""
            return unasked

    def recent(self) -> str:
        """Return the latest exchanges in words, for messages."""
        return "; ".join(str(each) for each in [each for each in self.exchanges if not each.remark][-_QUOTED:])

    def close(self) -> None:
        """Close the port, which stops the device; an exchange that is going on fails, and nothing reconnects."""
        self._closed = True
        self._port.close()

    def _exchange(
        self, request: bytes, complete: Complete, deadline_s: float, check: Check | None, *, fresh: bool
    ) -> bytes:
        if fresh:
            self._drain()
        begun, late = self.clock.now(), False
        if request:
            self._port.write(request)
        try:
            while not (end := complete(bytes(self._buffer)) if self._buffer else False):
                if late:
                    break
                left = begun + deadline_s - self.clock.now()
                late = left <= 0  # the answer may have come while this computer was busy
                self._buffer += self._port.read(min(max(left, 0.0), _SLICE_S))
                if len(self._buffer) > _LONGEST_REPLY:
                    break
                if check is not None:
                    check()
        except BaseException:
            self._remember(begun, request, bytes(self._buffer))
            raise
        if not end:
            self._remember(begun, request, bytes(self._buffer))
            length = len(self._buffer)
            self._buffer.clear()
            if length > _LONGEST_REPLY:
                raise DeviceError(
                    f"{self.device} on {self.address} sends without end ({length} bytes); check the baud rate, and "
                    "that this is its port"
                )
            raise NoAnswerError(
                f"{self.device} on {self.address} gave no complete answer within {deadline_s:g} s ({self.recent()}); "
                "check its power, its cable and the baud rate"
            )
        length = len(self._buffer) if end is True else int(end)
        reply = bytes(self._buffer[:length])
        del self._buffer[:length]
        self._remember(begun, request, reply)
        return reply

    def _drain(self) -> None:
        stale = bytes(self._buffer)
        self._buffer.clear()
        until = self.clock.now() + _LONGEST_DRAIN_S  # a device may go on sending
        while (data := self._port.read(0)) and self.clock.now() < until:
            stale = (stale + data)[-_KEPT_BYTES:]
        if stale:
            self._add(Exchange(self.clock.now(), b"", stale, 0.0))
            self._unasked = (self._unasked + stale)[-_KEPT_BYTES:]

    def _remember(self, begun: float, request: bytes, reply: bytes) -> None:
        self._add(Exchange(begun, request, reply, self.clock.now() - begun))

    def _add(self, exchange: Exchange) -> None:
        self._exchanges.append(exchange)
        if self._log is not None:
            self._log(self.device, exchange)

    def _is_news_of_guard(self, error: PortLostError) -> bool:
        """Return whether the guard has ended since the last exchange: the devices were stopped, which is no glitch."""
        news = isinstance(error, GuardEndedError) and not self._guard_reported
        self._guard_reported = news
        return news

    def _reconnect(self, error: PortLostError, check: Check | None) -> None:
        """Open the port again, trying for a while; raise the first error if it stays away."""
        self._buffer.clear()
        until = self.clock.now() + _RECONNECT_S
        while True:
            try:
                self._port.reopen()
                break
            except DeviceError:
                if self.clock.now() > until or self._closed:
                    raise error from None
                retry = self.clock.now() + _RETRY_S
                while self.clock.now() < retry:
                    if check is not None:
                        check()
                    self.clock.sleep(_NAP_S)
        self._guard_reported = False
        if self._closed:
            self._port.close()
            raise error
        if self._connected is not None:
            self._reconnecting = True
            try:
                self._connected()
            finally:
                self._reconnecting = False


def twice_alike(ask: Callable[[], _T]) -> tuple[_T, _T]:
    """Return two answers in a row, which are the same unless a device contradicts itself again and again."""
    last, again = ask(), ask()
    for _ in range(_MAX_ASKED - 2):
        if last == again:
            break
        last, again = again, ask()
    return last, again


def _quoted(data: bytes) -> str:
    text = data[:_QUOTED_BYTES].decode("ascii", "backslashreplace").encode("unicode_escape").decode()
    return f'"{text}"' + (" ..." if len(data) > _QUOTED_BYTES else "")
