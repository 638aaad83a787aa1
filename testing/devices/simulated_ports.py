"""Ports in memory that lead to simulated devices, on a simulated clock."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from ladarreg_core.acquisition.serial_port import PortLostError
from ladarreg_core.acquisition.simulated.twin import Twin
from ladarreg_core.errors import DeviceError
from testing.devices.simulated_clock import SimulatedClock

PREFIX = "memory:"


class _Plug:
    """A device and whether it is plugged in."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.times_plugged = 1
        self.is_in = True
        self.unread = b""


class MemoryServer:
    """Serves simulated devices in memory, as `TwinServer` does behind ports of the system; a context manager.

    Args:
        twins: the devices, of different names.
        clock: what they live by.
    """

    def __init__(self, twins: Sequence[Twin], *, clock: SimulatedClock) -> None:
        self.clock = clock
        self.plugs = {twin.name: _Plug(twin) for twin in twins}
        clock.every_tick(self._serve)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name in self.plugs:
            self.unplug(name)

    @property
    def addresses(self) -> dict[str, str]:
        """Address of each device, for `MemoryPorts`."""
        return {name: PREFIX + name for name in self.plugs}

    def now_s(self) -> float:
        """Return the time that the devices live in, s."""
        return self.clock.now()

    def unplug(self, name: str) -> None:
        """Take a device off its port, as if its cable were pulled."""
        self.plugs[name].is_in = False

    def plug(self, name: str) -> None:
        """Put a device back on its port, at the same address."""
        plug = self.plugs[name]
        if not plug.is_in:
            plug.is_in, plug.unread, plug.times_plugged = True, b"", plug.times_plugged + 1

    def _serve(self) -> None:
        for plug in self.plugs.values():
            came = plug.twin.due(self.clock.now())
            plug.unread = plug.unread + came if plug.is_in else b""


class MemoryPorts:
    """The ports of a run, as `Ports`; a context manager that stops the devices and closes the ports at its end."""

    def __init__(self, server: MemoryServer) -> None:
        self.clock = server.clock
        self._server = server
        self._open: list[tuple[MemoryPort, bytes]] = []

    def __enter__(self) -> MemoryPorts:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self, address: str, baud: int, *, stop: bytes, name: str) -> MemoryPort:
        """Open a port, as `Ports.open` does."""
        device = address.removeprefix(PREFIX)
        if device not in self._server.plugs:
            raise DeviceError(f"there is no port {address} for the {name}")
        port = MemoryPort(address, self._server.plugs[device], self.clock)
        self._open.append((port, stop))
        return port

    def close(self) -> None:
        """Stop the devices and close the ports."""
        ports, self._open = self._open, []
        for port, stop in ports:
            if port.is_there:
                port.write(stop)
            port.close()


class MemoryPort:
    """A `Port` in memory."""

    def __init__(self, address: str, plug: _Plug, clock: SimulatedClock) -> None:
        self.address, self._plug, self._clock = address, plug, clock
        self.closed = True
        self._times_plugged = 0
        self.reopen()

    @property
    def is_there(self) -> bool:
        """Whether it is open and has stayed plugged in."""
        return not self.closed and self._plug.is_in and self._plug.times_plugged == self._times_plugged

    def read(self, timeout_s: float) -> bytes:
        """Return what has come, or b'' if nothing comes in time."""
        if not self._plug.unread and timeout_s > 0:
            self._clock.wait_until(lambda: bool(self._plug.unread) or not self.is_there, timeout_s)
        self._require_there()
        found, self._plug.unread = self._plug.unread, b""
        return found

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._require_there()
        self._plug.twin.feed(data, self._clock.now())

    def reopen(self) -> None:
        """Close the port and open it again."""
        if not self._plug.is_in:
            raise DeviceError(f"there is no port {self.address}")
        self.closed, self._times_plugged = False, self._plug.times_plugged

    def close(self) -> None:
        """Close the port."""
        self.closed = True

    def _require_there(self) -> None:
        if self.closed:
            raise PortLostError(f"the port {self.address} has been closed")
        if not self.is_there:
            raise PortLostError(f"the port {self.address} has disappeared while it was in use; check the cable")
