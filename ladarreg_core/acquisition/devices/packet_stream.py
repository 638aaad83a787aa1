"""A spinning lidar that sends its measurements as UDP packets: a recording of a revolution or two for each stop."""

from __future__ import annotations

import select
import shutil
import socket
import time
from collections.abc import Callable
from pathlib import Path

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.interfaces import Arrival, Check
from ladarreg_core.errors import DeviceError, FormatError, ShapeError
from ladarreg_core.formats.packets.capture import Datagram, write_datagrams
from ladarreg_core.storage.atomic_write import replaced_file

_FIRST_S = 0.25  # two revolutions at 10 a second, so that one is whole
_TICK_S = 0.05
_BUFFER_BYTES = 8 << 20  # asked for; systems give less
_LARGEST = 1 << 16
_MAX_BYTES = 256 << 20
_NAME = "scan.pcap"


class PacketStream:
    """Listens on a UDP port and records what one sensor sends while the unit stands.

    The first recording is a quarter of a second long; if no revolution is whole in it, the next is twice as long.

    Args:
        port: UDP port that the sensor sends to.
        host: address of the sensor; empty: whatever sends there, if it is only one.
        sensor_file: description of the sensor that is needed to read its packets; None for none.
        is_readable: raises a `LadarregError` for a recording that contains no whole revolution.
        timeout_s: longest wait for one.
        clock: what the waiting is measured by.

    Raises:
        DeviceError: if the port cannot be listened on.
    """

    def __init__(
        self,
        port: int,
        *,
        host: str = "",
        sensor_file: Path | None = None,
        is_readable: Callable[[Path], object],
        timeout_s: float,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        self._port, self._sensor_file, self._is_readable = port, sensor_file, is_readable
        self._timeout_s, self._clock = timeout_s, clock
        try:
            self._host = socket.gethostbyname(host) if host else ""
        except OSError as error:
            raise DeviceError(
                f"the address {host!r} of the lidar is not known ({error}); give its IP address"
            ) from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"the UDP port {port} cannot be listened on ({error.strerror}); close the program that uses it, such "
                "as the maker's viewer, or have the lidar send to another port"
            ) from error
        self.port: int = self._socket.getsockname()[1]
        """The port that is listened on."""

    def arrived(self, stop: Arrival) -> None:
        """Do nothing: what came while the unit moved is thrown away when a measurement is asked for."""

    def next_file(self, folder: Path, *, check: Check) -> Path:
        """Record a whole revolution, and return the recording; the sensor's description lies beside it.

        Raises:
            DeviceError: if nothing comes, several sensors send, or no revolution is whole in time.
            Cancelled: if `check` raises it.
        """
        target = folder / _NAME
        folder.mkdir(parents=True, exist_ok=True)
        if self._sensor_file is not None:
            self._copy_description(target.with_suffix(".json"))
        begun, length_s, others, why = self._clock.now(), _FIRST_S, set[str](), ""
        while True:
            received, others = self._recorded(length_s, begun + self._timeout_s, check)
            if received:
                with replaced_file(target) as new, open(new, "wb") as stream:
                    write_datagrams(stream, received)
                try:
                    self._is_readable(target)
                    return target
                except (FormatError, ShapeError) as error:
                    why = str(error)
            if self._clock.now() - begun >= self._timeout_s:
                target.unlink(missing_ok=True)
                raise DeviceError(self._late(why, others))
            length_s *= 2

    def keep_strays(self, folder: Path) -> list[Path]:
        """Return nothing: what came while the unit moved is not kept."""
        return []

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def _recorded(self, length_s: float, until: float, check: Check) -> tuple[list[tuple[float, Datagram]], set[str]]:
        """Return what comes from the sensor within a time from its first packet on, and who else sends.

        Raises:
            DeviceError: if several send and none was named.
        """
        self._drain()
        received: list[tuple[float, Datagram]] = []
        senders, others, size = set[str](), set[str](), 0
        end = until
        while self._clock.now() < end and size < _MAX_BYTES:
            check()
            if not select.select([self._socket], [], [], _TICK_S)[0]:
                continue
            try:
                payload, (sender, *_) = self._socket.recvfrom(_LARGEST)
            except OSError:  # such as a packet whose checksum is wrong
                continue
            if self._host and sender != self._host:
                others.add(sender)
                continue
            senders.add(sender)
            if len(senders) > 1:
                raise DeviceError(
                    f"several lidars send to the UDP port {self._port} ({', '.join(sorted(senders))}); name one of "
                    "them as 'host' of 'scanner' in the plan"
                )
            if not received:
                end = min(until, self._clock.now() + length_s)
            received.append((time.time(), Datagram(socket.inet_aton(sender), self._port, payload)))
            size += len(payload)
        return received, others

    def _drain(self) -> None:
        """Throw away what has come so far; bounded, since packets keep coming."""
        dropped = 0
        while dropped < _MAX_BYTES:
            try:
                dropped += 1 + len(self._socket.recv(_LARGEST))
            except BlockingIOError:
                return
            except OSError:
                continue

    def _copy_description(self, target: Path) -> None:
        assert self._sensor_file is not None
        try:
            with replaced_file(target) as new:
                shutil.copyfile(self._sensor_file, new)
        except OSError as error:
            raise DeviceError(
                f"the description of the lidar, {self._sensor_file}, cannot be read ({error.strerror}); restore the "
                "file, and resume"
            ) from error

    def _late(self, why: str, others: set[str]) -> str:
        """Return what came in place of a measurement."""
        if why:
            return f"what came on the UDP port {self._port} within {self._timeout_s:.0f} s is no measurement: {why}"
        sent = f" ({', '.join(sorted(others)[:4])} sent something)" if others else ""
        source = f"from {self._host} " if self._host else ""
        return (
            f"nothing came {source}on the UDP port {self._port} within {self._timeout_s:.0f} s{sent}; check that the "
            "lidar is on, that it sends to this computer and this port, and that no firewall keeps its packets away"
        )
