"""A spinning lidar that sends UDP packets: those of a recording, or what it measures on a simulated unit."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.velodyne_packets import velodyne_packets
from ladarreg_core.acquisition.simulated.world import Bench
from ladarreg_core.formats.packets.capture import datagrams
from ladarreg_core.formats.packets.velodyne_packet import MODELS, VLP_16
from ladarreg_core.foundations.arrays import FloatArray, IntArray

_HOST = "127.0.0.1"
_KEY_STEP_RAD = 1e-5
_AT_ONCE = 8  # packets; a thread cannot sleep for as little as lies between two
_FULL = 255.0  # reflectivity of white paper at any distance


class LidarTwin:
    """Sends packets endlessly, once it is switched on; a context manager.

    Args:
        packets: what it sends next.
        seconds: how long that takes.
        port: UDP port of this machine that it sends to; 0: a free one.
        clock: what it lives by.

    Attributes:
        port: that port.
    """

    def __init__(
        self, packets: Callable[[], Sequence[bytes]], *, seconds: float, port: int = 0, clock: Clock = REAL_CLOCK
    ) -> None:
        self._packets, self._seconds, self._clock = packets, seconds, clock
        self.port = port or _free_port()
        self._running = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @staticmethod
    def replaying(recording: Path, *, seconds: float, port: int = 0) -> LidarTwin:
        """Return one that sends the packets of a recording, in so many seconds, again and again."""
        with open(recording, "rb") as stream:
            packets = [datagram.payload for datagram in datagrams(stream)]
        return LidarTwin(lambda: packets, seconds=seconds, port=port)

    def __enter__(self) -> LidarTwin:
        return self

    def switch_on(self) -> None:
        """Begin to send, if it does not yet."""
        if not self._running.is_set():
            self._running.set()
            self._clock.start(self._thread)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._running.is_set():
            self._running.clear()
            self._clock.join(self._thread)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while self._running.is_set():
                packets = self._packets()
                pause_s = self._seconds / max(1, len(packets)) * _AT_ONCE
                for first in range(0, len(packets), _AT_ONCE):
                    for packet in packets[first : first + _AT_ONCE]:
                        sender.sendto(packet, (_HOST, self.port))
                    self._clock.sleep(pause_s)
                    if not self._running.is_set():
                        return


class VelodyneOnBench:
    """What a VLP-16 measures where the unit of a bench stands, turn by turn.

    Args:
        bench: the bench; the lidar sits where its scanner with a field of view does.
        rate_hz: turns a second.
    """

    def __init__(self, bench: Bench, *, rate_hz: float = 10.0) -> None:
        self._bench, self.rate_hz = bench, rate_hz
        self._made: tuple[tuple[int, int], list[bytes]] | None = None

    def packets(self) -> list[bytes]:
        """Return the packets of a turn; the unit is taken as standing still meanwhile."""
        at = self._bench.pose_at(self._bench.now())
        key = (round(at.pan_rad / _KEY_STEP_RAD), round(at.tilt_rad / _KEY_STEP_RAD))
        if self._made is None or self._made[0] != key:
            made = velodyne_packets(
                VLP_16, lambda lasers, azimuth: self._measure(at, lasers, azimuth, key), rate_hz=self.rate_hz, turns=1.0
            )
            self._made = key, made
        return self._made[1]

    def _measure(
        self, at: PanTilt, lasers: IntArray, azimuth: FloatArray, key: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        model = MODELS[VLP_16]
        elevation = np.radians(np.asarray(model.elevations_deg))[lasers]
        beams = np.stack(
            [np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        origins = np.zeros_like(beams)
        origins[..., 2] = model.heights_m[lasers]
        ranges, intensity = self._bench.scan_beams(
            at, origins.reshape(-1, 3), beams.reshape(-1, 3), noise_key=(*key, len(azimuth))
        )
        # As a sensor that calibrates: the amplitude without its fall with the squared range; 1 is white paper at 2.5 m.
        white = intensity.astype(np.float64) * (ranges.astype(np.float64) / 2.5) ** 2
        return (
            np.nan_to_num(ranges.astype(np.float64)).reshape(azimuth.shape),
            np.nan_to_num(_FULL * white).reshape(azimuth.shape),
        )


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])
