"""A serial port of this machine, or a pyserial URL, opened directly; its failures in one sentence each."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import select
import sys
import threading
import time
from typing import Any, Protocol

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.errors import DeviceError

_POLL_S = 0.02
_WRITE_S = 0.5
_LOCK_S = 0.2
_PIECE = 4096
_FAILURES = (OSError, TypeError, AttributeError, ValueError)
"""What pyserial raises; all but the first after a close on another thread."""
_NO_PORTS = "no serial port is connected"


class PortLostError(DeviceError):
    """A port that was open and has disappeared: unplugged, or its process has ended."""


class Port(Protocol):
    """A stream of bytes to and from a device."""

    address: str
    """Where it leads, as stated."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, or b'' if nothing comes in time; raises `PortLostError`."""

    def write(self, data: bytes) -> None:
        """Send bytes, whole and before those of a later call; raises `PortLostError`."""

    def reopen(self) -> None:
        """Close the port and open it again; raises `DeviceError` if it is not there."""

    def close(self) -> None:
        """Close the port; never raises."""


class SerialPort:
    """A `Port` that this process holds.

    Args:
        address: name of a serial port, or a pyserial URL such as `socket://host:port`.
        baud: bits a second.

    Raises:
        DeviceError: if it is absent, busy or not permitted, with the ports that there are.
    """

    def __init__(self, address: str, baud: int) -> None:
        self.address, self._baud = address, baud
        self._writing, self._reading = threading.Lock(), threading.Lock()
        self.closed = False
        """Whether it was closed and is free to be opened again."""
        self._serial: Any = _opened(address, baud)

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, or b'' if nothing comes in time."""
        until = time.monotonic() + timeout_s
        try:
            while True:
                with self._reading:
                    found = b"" if self.closed else self._read_some()
                if self.closed:
                    raise PortLostError(f"the port {self.address} has been closed")
                if found or time.monotonic() >= until:
                    return found
        except _FAILURES as error:
            raise PortLostError(_lost(self.address)) from error

    def write(self, data: bytes) -> None:
        """Send bytes."""
        # The lock keeps commands whole; a halt does not wait longer for a write that hangs.
        held = self._writing.acquire(timeout=_LOCK_S)
        try:
            self._serial.write(data)
        except _FAILURES as error:
            if type(error).__name__ == "SerialTimeoutException":
                raise PortLostError(
                    f"the device on the port {self.address} takes no bytes; check its power, its cable and its flow "
                    "control"
                ) from error
            raise PortLostError(_lost(self.address)) from error
        finally:
            if held:
                self._writing.release()

    def reopen(self) -> None:
        """Close the port and open it again."""
        self.close()
        self._serial = _opened(self.address, self._baud)
        self.closed = False

    def close(self) -> None:
        """Close the port."""
        self.closed = True
        # While another thread awaits bytes the system keeps the port, and with it the lock on it.
        free = self._reading.acquire(timeout=_LOCK_S)
        with contextlib.suppress(*_FAILURES):
            self._serial.close()
        if free:
            self._reading.release()

    def _read_some(self) -> bytes:
        """Return what has come, or b'' after a short while."""
        if self.address.startswith("socket:"):  # which says of waiting bytes only that there are some
            if not select.select([self._serial.fileno()], [], [], _POLL_S)[0]:
                return b""
            self._serial.timeout = 0
            return bytes(self._serial.read(_PIECE))
        return bytes(self._serial.read(max(1, self._serial.in_waiting)))


class ControlLine:
    """A control line of a serial port, which drives the trigger input of a device; inactive until it is pulsed.

    Args:
        address: name of a serial port, or a pyserial URL.
        line: `rts` or `dtr`.
        clock: what a pulse is measured by.

    Raises:
        DeviceError: as of `SerialPort`.
    """

    def __init__(self, address: str, line: str, *, clock: Clock = REAL_CLOCK) -> None:
        import serial

        self._address, self._line, self._clock = address, line, clock
        try:
            self._serial: Any = serial.serial_for_url(address, do_not_open=True)
            self._serial.rts = self._serial.dtr = False  # opening must not trigger anything
            self._serial.open()
        except _FAILURES as error:
            raise DeviceError(_refusal(address, error)) from error

    def pulse(self, seconds: float) -> None:
        """Make the line active for a moment.

        Raises:
            PortLostError: if the port has disappeared.
        """
        try:
            setattr(self._serial, self._line, True)
            try:
                self._clock.sleep(seconds)
            finally:
                setattr(self._serial, self._line, False)
        except _FAILURES as error:
            raise PortLostError(_lost(self._address)) from error

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(*_FAILURES):
            self._serial.close()


def port_names() -> list[str]:
    """Return the names of the serial ports of this machine."""
    from serial.tools.list_ports import comports

    return sorted(port.device for port in comports())


def described_ports() -> list[tuple[str, str]]:
    """Return the serial ports of this machine, each with what the system says of it."""
    from serial.tools.list_ports import comports

    found = []
    for port in sorted(comports(), key=lambda port: str(port.device)):
        parts = (port.description, port.manufacturer, port.serial_number and f"serial number {port.serial_number}")
        said = ", ".join(dict.fromkeys(str(part) for part in parts if part and part != "n/a"))
        found.append((str(port.device), said or "no description"))
    return found


def why_shut(name: str) -> str:
    """Return why a serial port of this machine cannot be opened at present; '' if it can. Nothing is sent.

    Args:
        name: as `described_ports` lists it.
    """
    import serial

    port = serial.Serial()
    port.port, port.dtr, port.rts = name, False, False  # some devices start anew when these lines change
    try:
        if sys.platform != "win32":
            port.exclusive = True
        port.open()
    except _FAILURES as error:
        return _refusal(name, error)
    with contextlib.suppress(*_FAILURES):
        port.close()
    return ""


def _opened(address: str, baud: int) -> Any:
    import serial

    options: dict[str, Any] = {"baudrate": baud, "timeout": _POLL_S, "write_timeout": _WRITE_S}
    if "://" not in address:
        options["exclusive"] = True
    try:
        port = serial.serial_for_url(address, **options)
    except (OSError, ValueError, TypeError, AttributeError) as error:  # the last two by addresses such as socket://x
        raise DeviceError(_refusal(address, error)) from error
    _keep_others_out(address, port)
    return port


def _keep_others_out(address: str, port: Any) -> None:
    """Have the system refuse this port to programs that heed no lock, too, until it is closed."""
    if sys.platform == "win32" or not re.match(r"/dev/(tty[A-Z]|rfcomm|cu\.|tty\.)", os.path.realpath(address)):
        return  # Windows does it by itself; on a pseudo-terminal the refusal would outlive the closing
    import fcntl
    import termios

    with contextlib.suppress(OSError, AttributeError):
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)


def _refusal(address: str, error: Exception) -> str:
    """Return why a port cannot be opened, and what to do."""
    text, number = str(error).lower(), getattr(error, "errno", None)
    address = _printable(address)
    there = port_names()
    listed = f"this machine has {', '.join(there)}" if there else _NO_PORTS
    if not address:
        return f"the port has no name; {listed}"
    if address.startswith("socket:") and not re.search(r":\d{1,5}(\?|$)", address):
        return f"the address {address} names no port; write for example socket://192.168.0.10:10940"
    if "://" in address:
        return f"{address} cannot be opened ({_reason(error)}); check the address, and that something listens there"
    # Windows states its reasons in the language of the user, but Python names them.
    windows = sys.platform == "win32"
    if "exclusive" in text or number == errno.EBUSY or "resource busy" in text or (windows and "permission" in text):
        return f"the port {address} is in use by another program; close that program, or choose another port"
    if number == errno.EACCES or "permission" in text:
        return (
            f"the port {address} may not be opened by this user; on Linux add the user to the group dialout "
            "(sudo usermod -aG dialout $USER) and log in again"
        )
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "filenotfound" in text or "no such" in text:
        return f"there is no port {address}; {listed}: check the cable and the name"
    if number == errno.EISDIR or "inappropriate ioctl" in text or "input/output error" in text:
        return f"{address} is no serial port, or no device is behind it; {listed}"
    return f"the port {address} cannot be opened ({_reason(error)}); {listed}"


def _reason(error: Exception) -> str:
    reason = str(getattr(error, "strerror", None) or error)
    return _printable(reason)[:120]


def _printable(text: str) -> str:
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def _lost(address: str) -> str:
    return f"the port {address} has disappeared while it was in use; check the cable and the power of the device"
