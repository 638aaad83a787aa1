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
from typing import Any, BinaryIO, Protocol, cast

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.guard import CONTROL, read_frame, write_frame
from ladarreg_core.acquisition.serial_port import Port, PortLostError, SerialPort
from ladarreg_core.acquisition.twin_address import is_twin, resolved_twin
from ladarreg_core.errors import DeviceError

_BEAT_S = 0.1
_OPEN_S = 10.0
_END_S = 2.0
_LAST_WORD_S = 0.2
_KEPT_BYTES = 1 << 22


class GuardEndedError(PortLostError):
    """The guard has ended, and has stopped the devices: what was under way counts for nothing.

    Args:
        text: what happened.
        hung: whether it did so because this program hung for a moment.
    """

    def __init__(self, text: str, *, hung: bool = False) -> None:
        super().__init__(text)
        self.hung = hung


class PortSource(Protocol):
    """What drivers get their ports from."""

    @property
    def clock(self) -> Clock:
        """The clock that the devices behind the ports live by."""

    def open(self, address: str, baud: int, *, stop: bytes, name: str) -> Port:
        """Open a port, as `Ports.open` does."""


class Ports:
    """The ports of a run; a context manager that stops the devices and closes the ports at its end.

    Args:
        guarded: whether a guard process holds the ports; otherwise this process does, and nothing stops the devices if
            it is killed.
    """

    clock: Clock = REAL_CLOCK

    def __init__(self, *, guarded: bool = True) -> None:
        self._guarded = guarded
        self._guard: GuardProcess | None = None
        self._open: list[tuple[GuardedPort | SerialPort, bytes]] = []
        self._opening = threading.RLock()

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
        with self._opening:
            # What was closed, such as after a device that did not answer, is free again.
            self._open = [each for each in self._open if not each[0].closed]
            if any(_is_same(port.address, found) for port, _ in self._open):
                raise DeviceError(f"the port {address} of the {name} is already used by another device of this run")
            port = GuardedPort(self, found, baud, stop) if self._guarded else SerialPort(found, baud)
            self._open.append((port, stop))
        return port

    def guard(self) -> GuardProcess:
        """Return the guard, a new one if there is none that lives."""
        with self._opening:
            if self._guard is not None and self._guard.gone is not None:
                self._guard.close()
                self._guard = None
            if self._guard is None:
                self._guard = GuardProcess()
            return self._guard

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
    """A `Port` that a guard process holds."""

    def __init__(self, ports: Ports, address: str, baud: int, stop: bytes) -> None:
        self.address = address
        self._ports, self._baud, self._stop = ports, baud, stop
        self._guard = ports.guard()
        self._channel = self._guard.open(address, baud, stop)
        self.closed = False
        """Whether it was closed and is free to be opened again."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, or b'' if nothing comes in time; raises `GuardEndedError`, too."""
        return self._guard.receive(self._channel, timeout_s)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._guard.send(self._channel, data)

    def reopen(self) -> None:
        """Close the port and open it again, by another guard if this one has ended."""
        self.close()
        self._guard = self._ports.guard()
        self._channel = self._guard.open(self.address, self._baud, self._stop)
        self.closed = False

    def close(self) -> None:
        """Stop the device and close the port."""
        self.closed = True
        self._guard.close_channel(self._channel)


class GuardProcess:
    """This program's end of a guard."""

    def __init__(self) -> None:
        # Out of reach of what a terminal sends to all processes of this program at once: the guard outlives them.
        apart: dict[str, Any] = (
            {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}  # type: ignore[attr-defined,unused-ignore]
            if sys.platform == "win32"
            else {"start_new_session": True}
        )
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "ladarreg_core.acquisition.devices.guard"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=_environment(), **apart,
            )  # fmt: skip
        except OSError as error:
            raise DeviceError(f"the process that is to hold the ports could not be started ({error})") from error
        self.gone: str | None = None
        """Why it has ended; None while it lives."""
        self._hung = False
        self._changed = threading.Condition()
        self._received: dict[int, bytearray] = {}
        self._opened: dict[int, str | None] = {}
        self._lost: dict[int, str] = {}
        self._writing = threading.Lock()
        self._next = 1
        self._closed = threading.Event()
        threading.Thread(target=self._listen, daemon=True, name="guard replies").start()
        threading.Thread(target=self._beat, daemon=True, name="guard beats").start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def open(self, address: str, baud: int, stop: bytes) -> int:
        """Open a port and return its channel."""
        with self._changed:
            channel, self._next = self._next, self._next + 1
            self._received[channel] = bytearray()
        self._tell({"open": channel, "address": address, "baud": baud, "stop": stop.hex()})
        until = time.monotonic() + _OPEN_S
        with self._changed:
            self._changed.wait_for(lambda: channel in self._opened or self.gone is not None, until - time.monotonic())
            self._require_life()
            opened, refusal = channel in self._opened, self._opened.get(channel)
        if not opened:
            self.close_channel(channel)
            raise DeviceError(f"the port {address} could not be opened within {_OPEN_S:.0f} s; check the device")
        if refusal is not None:
            raise DeviceError(refusal)
        return channel

    def receive(self, channel: int, timeout_s: float) -> bytes:
        """Return what has come on a channel."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._received.get(channel) or channel in self._lost or self.gone is not None, timeout_s
            )
            if buffer := self._received.get(channel):
                data = bytes(buffer)
                buffer.clear()
                return data
            self._require_open(channel)
            return b""

    def send(self, channel: int, data: bytes) -> None:
        """Send bytes on a channel."""
        self._require_open(channel)
        self._write(channel, data)

    def close_channel(self, channel: int) -> None:
        """Have the guard stop the device of a channel and close its port."""
        with self._changed:
            self._lost.setdefault(channel, "the port has been closed")
            self._received.pop(channel, None)
            self._changed.notify_all()
        with contextlib.suppress(DeviceError):
            self._tell({"close": channel})

    def close(self) -> None:
        """End the guard, which stops what is still open."""
        self._closed.set()
        assert self._process.stdin is not None
        with contextlib.suppress(DeviceError):
            self._tell({"end": True})  # a process that was forked from this one may keep the pipe open
        with contextlib.suppress(OSError), self._writing:
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs in a driver of the system
                self._process.wait(_END_S)

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
                if channel == CONTROL:
                    self._note(json.loads(content))
                elif (buffer := self._received.get(channel)) is not None:
                    buffer += content
                    del buffer[:-_KEPT_BYTES]  # nobody reads, and the device goes on sending
                self._changed.notify_all()
        with self._changed:
            if self.gone is None:
                self.gone = _GONE.format(why="has ended unexpectedly")
            self._changed.notify_all()

    def _note(self, message: dict[str, Any]) -> None:
        if "opened" in message:
            self._opened[message["opened"]] = None
        elif "refused" in message:
            self._opened[message["refused"]] = str(message["text"])
        elif "lost" in message:
            self._lost.setdefault(message["lost"], str(message["text"]))
        elif "ended" in message:
            self._hung = bool(message["hung"])
            self.gone = _GONE.format(why=f"has ended, because {message['ended']}")

    def _require_life(self) -> None:
        if self.gone is not None:
            raise GuardEndedError(self.gone, hung=self._hung)

    def _require_open(self, channel: int) -> None:
        if channel in self._lost:
            raise PortLostError(self._lost[channel])
        self._require_life()

    def _tell(self, message: dict[str, Any]) -> None:
        self._write(CONTROL, json.dumps(message).encode())

    def _write(self, channel: int, content: bytes) -> None:
        assert self._process.stdin is not None
        try:
            with self._writing:
                write_frame(cast(BinaryIO, self._process.stdin), channel, content)
        except (OSError, ValueError) as error:
            with self._changed:  # what it said last may still be on its way
                self._changed.wait_for(lambda: self.gone is not None, _LAST_WORD_S)
                said = self.gone or _GONE.format(why="has ended unexpectedly")
                raise GuardEndedError(said, hung=self._hung) from error


_GONE = (
    "the process that holds the ports {why}, and has stopped the devices if it could; check that they stand still and "
    "that the laser is off, and resume or connect again"
)


def _is_same(address: str, other: str) -> bool:
    """Return whether two addresses lead to one port, by one name or by several."""
    if address == other:
        return True
    return "://" not in address + other and os.path.realpath(address) == os.path.realpath(other)


def _environment() -> dict[str, str]:
    """Return the environment of a process that imports the package from where this one does."""
    paths = [path or os.getcwd() for path in sys.path]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
