"""Serves simulated devices behind real ports: pseudo-terminals where there are any, else sockets."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.simulated.twin import Twin

_TICK_S = 0.002
_MAX_IDLE_TICK_S = 0.016  # below the 25 ms between two turns of a scanner; input wakes a device at once
_PIECE = 4096
_MAX_UNSENT = 1 << 20  # bytes; a busy host takes them seconds later, and more is lost, as if nobody listened


class DeviceServer(Protocol):
    """Connects simulated devices with ports; a context manager."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def clock(self) -> Clock:
        """The clock that the devices live by."""

    @property
    def addresses(self) -> dict[str, str]:
        """Address of each device."""

    def now_s(self) -> float:
        """Return the time that the devices are given, s."""

    def unplug(self, name: str) -> None:
        """Take a device off its port, as if its cable were pulled."""

    def plug(self, name: str) -> None:
        """Put a device back on its port, at the same address."""


class TwinServer:
    """Serves simulated devices, each on a port of its own; a context manager.

    Args:
        twins: the devices, of different names.
        sockets: use sockets also where there are pseudo-terminals.
    """

    clock: Clock = REAL_CLOCK

    def __init__(self, twins: Sequence[Twin], *, sockets: bool = False) -> None:
        self._begun_s = time.monotonic()
        self._folder = tempfile.TemporaryDirectory(prefix="ladarreg-twin-", ignore_cleanup_errors=True)
        kind = _Socket if sockets or sys.platform == "win32" else _Terminal
        self._ends: dict[str, _End] = {twin.name: kind(Path(self._folder.name) / twin.name) for twin in twins}
        self._twins = {twin.name: twin for twin in twins}
        self._running = True
        self._threads = [threading.Thread(target=self._serve, args=(name,), daemon=True) for name in self._twins]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running = False
        for thread in self._threads:
            thread.join(2)
        for end in self._ends.values():
            end.close()
        self._folder.cleanup()

    @property
    def addresses(self) -> dict[str, str]:
        """Address of each device."""
        return {name: end.address for name, end in self._ends.items()}

    def now_s(self) -> float:
        """Return the time that the devices live in, s."""
        return time.monotonic() - self._begun_s

    def unplug(self, name: str) -> None:
        """Take a device off its port, as if its cable were pulled."""
        self._ends[name].close()

    def plug(self, name: str) -> None:
        """Put a device back on its port, at the same address."""
        self._ends[name].open()

    def _serve(self, name: str) -> None:
        twin, end, tick_s = self._twins[name], self._ends[name], _TICK_S
        while self._running:
            data = end.read(tick_s)
            now = self.now_s()
            if data:
                twin.feed(data, now)
            due = twin.due(now)
            end.write(due)
            tick_s = _TICK_S if data or due else min(2 * tick_s, _MAX_IDLE_TICK_S)


class _End:
    """The device's end of a port."""

    address: str

    def open(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def read(self, timeout_s: float) -> bytes:
        raise NotImplementedError

    def write(self, data: bytes) -> None:
        """Send what could not be sent before, and data; what the system does not take now is kept for the next call."""
        raise NotImplementedError


class _Terminal(_End):
    """A pseudo-terminal, under a name that stays when it is closed and opened again."""

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        self._lock = threading.Lock()
        self._ends: tuple[int, int] | None = None
        self._unsent = b""
        self.open()

    def open(self) -> None:
        import pty
        import tty

        with self._lock:
            if self._ends is not None:
                return
            master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            Path(self.address).unlink(missing_ok=True)
            os.symlink(os.ttyname(slave), self.address)
            self._ends = master, slave

    def close(self) -> None:
        with self._lock:
            ends, self._ends = self._ends, None
            Path(self.address).unlink(missing_ok=True)
            for end in ends or ():
                os.close(end)

    def read(self, timeout_s: float) -> bytes:
        with self._lock:
            ends = self._ends
            if ends is not None:
                with contextlib.suppress(OSError):
                    if select.select([ends[0]], [], [], timeout_s)[0]:
                        return os.read(ends[0], _PIECE)
                return b""
        time.sleep(timeout_s)
        return b""

    def write(self, data: bytes) -> None:
        with self._lock:
            self._unsent = (self._unsent + data)[:_MAX_UNSENT] if self._ends is not None else b""
            if self._ends is not None and self._unsent:
                with contextlib.suppress(OSError):  # the terminal is full
                    self._unsent = self._unsent[os.write(self._ends[0], self._unsent) :]


class _Socket(_End):
    """A socket on this machine."""

    def __init__(self, path: Path) -> None:
        self._lock = threading.Lock()
        self._port = 0
        self._listening: socket.socket | None = None
        self._host: socket.socket | None = None
        self._unsent = b""
        self.open()
        self.address = f"socket://127.0.0.1:{self._port}"

    def open(self) -> None:
        with self._lock:
            if self._listening is not None:
                return
            listening = socket.socket()
            if sys.platform != "win32":
                listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(("127.0.0.1", self._port))
            listening.listen(1)
            self._port = listening.getsockname()[1]
            self._listening = listening

    def close(self) -> None:
        with self._lock:
            for one in (self._host, self._listening):
                if one is not None:
                    one.close()
            self._host = self._listening = None

    def read(self, timeout_s: float) -> bytes:
        with self._lock:
            sources = [one for one in (self._host, self._listening) if one is not None]
            with contextlib.suppress(OSError):
                for ready in select.select(sources, [], [], timeout_s)[0] if sources else ():
                    if ready is self._listening:
                        self._accept(ready)
                    else:
                        data = bytes(ready.recv(_PIECE))
                        if not data:
                            ready.close()
                            self._host = None
                        return data
        if not sources:
            time.sleep(timeout_s)
        return b""

    def _accept(self, listening: Any) -> None:
        host, _ = listening.accept()
        if self._host is None:
            host.setblocking(False)
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._host, self._unsent = host, b""
        else:  # a port belongs to one program
            host.close()

    def write(self, data: bytes) -> None:
        with self._lock:
            self._unsent = (self._unsent + data)[:_MAX_UNSENT] if self._host is not None else b""
            if self._host is not None and self._unsent:
                with contextlib.suppress(OSError):  # the connection is full, or has ended, which `read` will find
                    self._unsent = self._unsent[self._host.send(self._unsent) :]
