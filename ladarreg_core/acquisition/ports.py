"""Ports for devices, held by a guard process so that the devices stop when this program does."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from types import TracebackType
from typing import Any, BinaryIO, cast

from ladarreg_core.acquisition.guard import CONTROL, read_frame, write_frame
from ladarreg_core.acquisition.serial_port import Port, PortLostError, SerialPort
from ladarreg_core.acquisition.twin_address import is_twin, resolved_twin
from ladarreg_core.errors import DeviceError

_BEAT_S = 0.1
_OPEN_S = 10.0
_END_S = 2.0
_MOST_CHANNELS = 255


class Ports:
    """The ports of a run; a context manager that stops the devices and closes the ports at its end.

    Args:
        guarded: whether a guard process holds the ports; otherwise this process does, and nothing stops the devices if
            it is killed.
    """

    def __init__(self, *, guarded: bool = True) -> None:
        self._guarded = guarded
        self._guard: _GuardProcess | None = None
        self._open: list[tuple[Port, bytes]] = []

    def __enter__(self) -> Ports:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self, address: str, baud: int, *, stop: bytes, name: str) -> Port:
        """Open a port.

        Args:
            address: a serial port, a pyserial URL, or `twin:NAME?seed=N`.
            baud: bits a second.
            stop: what stops the device; sent at the end of this program, however it ends.
            name: the device, for messages.

        Raises:
            DeviceError: if the port is absent, busy or not permitted.
        """
        found = resolved_twin(address) if is_twin(address) else address
        if any(port.address == found for port, _ in self._open):
            raise DeviceError(f"the port {address} of the {name} is already used by another device of this run")
        if self._guarded:
            if self._guard is None:
                self._guard = _GuardProcess()
            port: Port = GuardedPort(self._guard, found, baud, stop)
        else:
            port = SerialPort(found, baud)
        self._open.append((port, stop))
        return port

    def release(self, address: str) -> None:
        """Stop the device at an address and close its port, so that it can be opened otherwise."""
        found = resolved_twin(address) if is_twin(address) else address
        for port, _ in [each for each in self._open if each[0].address == found]:
            port.close()
        self._open = [each for each in self._open if each[0].address != found]

    def close(self) -> None:
        """Stop the devices and close the ports."""
        ports, self._open = self._open, []
        for port, stop in ports:
            try:
                if not self._guarded:  # the guard does it by itself
                    port.write(stop)
            except DeviceError:
                pass
            port.close()
        if self._guard is not None:
            self._guard.close()
            self._guard = None


class GuardedPort:
    """A `Port` that the guard process holds."""

    def __init__(self, guard: _GuardProcess, address: str, baud: int, stop: bytes) -> None:
        self.address = address
        self._guard, self._baud, self._stop = guard, baud, stop
        self._channel = guard.open(address, baud, stop)

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, or b'' if nothing comes in time."""
        return self._guard.receive(self._channel, timeout_s)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._guard.send(self._channel, data)

    def reopen(self) -> None:
        """Close the port and open it again."""
        self.close()
        self._channel = self._guard.open(self.address, self._baud, self._stop)

    def close(self) -> None:
        """Stop the device and close the port."""
        self._guard.close_channel(self._channel)


class _GuardProcess:
    """This program's end of the guard."""

    def __init__(self) -> None:
        own_group: dict[str, Any] = (
            {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}  # type: ignore[attr-defined,unused-ignore]
            if sys.platform == "win32"
            else {"start_new_session": True}
        )
        self._process = subprocess.Popen(
            [sys.executable, "-m", "ladarreg_core.acquisition.guard"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=_environment(), **own_group,
        )  # fmt: skip
        self._changed = threading.Condition()
        self._received: dict[int, bytearray] = {}
        self._opened: dict[int, str | None] = {}
        self._lost: dict[int, str] = {}
        self._writing = threading.Lock()
        self._next = 1
        self._closed = threading.Event()
        threading.Thread(target=self._listen, daemon=True, name="guard replies").start()
        threading.Thread(target=self._beat, daemon=True, name="guard beats").start()

    def open(self, address: str, baud: int, stop: bytes) -> int:
        """Open a port and return its channel."""
        with self._changed:
            channel, self._next = self._next, self._next + 1
            if channel > _MOST_CHANNELS:
                raise DeviceError(f"ports were opened {channel - 1} times in one run; end it and resume with a new one")
            self._received[channel] = bytearray()
        self._tell({"open": channel, "address": address, "baud": baud, "stop": stop.hex()})
        until = time.monotonic() + _OPEN_S
        with self._changed:
            while channel not in self._opened and channel not in self._lost:
                if not self._changed.wait(until - time.monotonic()) and time.monotonic() >= until:
                    raise DeviceError(
                        f"the port {address} could not be opened within {_OPEN_S:.0f} s; check the device"
                    )
            if channel in self._lost:
                raise PortLostError(self._lost[channel])
            refusal = self._opened[channel]
        if refusal is not None:
            raise DeviceError(refusal)
        return channel

    def receive(self, channel: int, timeout_s: float) -> bytes:
        """Return what has come on a channel."""
        until = time.monotonic() + timeout_s
        with self._changed:
            while not (buffer := self._received.get(channel)):
                if channel in self._lost:
                    raise PortLostError(self._lost[channel])
                left = until - time.monotonic()
                if left <= 0:
                    return b""
                self._changed.wait(left)
            data = bytes(buffer)
            buffer.clear()
            return data

    def send(self, channel: int, data: bytes) -> None:
        """Send bytes on a channel."""
        if channel in self._lost:
            raise PortLostError(self._lost[channel])
        self._write(channel, data)

    def close_channel(self, channel: int) -> None:
        """Have the guard stop the device of a channel and close its port."""
        with contextlib.suppress(DeviceError):
            self._tell({"close": channel})

    def close(self) -> None:
        """End the guard, which stops what is still open."""
        self._closed.set()
        assert self._process.stdin is not None
        try:
            with self._writing:
                self._process.stdin.close()
        except OSError:
            pass
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _beat(self) -> None:
        number = 0
        while not self._closed.wait(_BEAT_S):
            number += 1
            try:
                self._tell({"beat": number})
            except DeviceError:
                return

    def _listen(self) -> None:
        assert self._process.stdout is not None
        while frame := read_frame(cast(BinaryIO, self._process.stdout)):
            channel, content = frame
            with self._changed:
                if channel != CONTROL:
                    self._received.setdefault(channel, bytearray()).extend(content)
                else:
                    message = json.loads(content)
                    if "opened" in message:
                        self._opened[message["opened"]] = None
                    elif "refused" in message:
                        self._opened[message["refused"]] = str(message["text"])
                    elif "lost" in message:
                        self._lost[message["lost"]] = str(message["text"])
                self._changed.notify_all()
        with self._changed:
            for channel in range(1, self._next):
                self._lost.setdefault(channel, _GUARD_GONE)
            self._changed.notify_all()

    def _tell(self, message: dict[str, Any]) -> None:
        self._write(CONTROL, json.dumps(message).encode())

    def _write(self, channel: int, content: bytes) -> None:
        assert self._process.stdin is not None
        try:
            with self._writing:
                write_frame(cast(BinaryIO, self._process.stdin), channel, content)
        except (OSError, ValueError) as error:
            raise PortLostError(_GUARD_GONE) from error


_GUARD_GONE = (
    "the process that holds the ports has ended, and has stopped the devices if it could; check that they stand still "
    "and that the laser is off, and connect again"
)


def _environment() -> dict[str, str]:
    """Return the environment of a process that imports the package from where this one does."""
    paths = [path for path in sys.path if path]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
