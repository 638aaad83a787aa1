"""Simulated devices in one room, behind real ports: what tests, demonstrations and `twin:` addresses connect to."""

from __future__ import annotations

import json
import socket
import threading
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.devices import PanTilt
from ladarreg_core.errors import OptionError
from ladarreg_core.twins.flir_twin import COUNTS_PER_RAD, FlirTwin
from ladarreg_core.twins.scip_twin import UTM_30LX, ScipModel, ScipTwin
from ladarreg_core.twins.server import TwinServer
from ladarreg_core.twins.world import Bench

_INTENSITY = 2000.0
_AT_REST_RAD = 1e-9


class TwinDevices:
    """A pan/tilt unit and a line scanner on it in a simulated room; a context manager.

    Args:
        scene: the room.
        seed: of room, mounts and noise.
        sockets: serve by sockets also where there are pseudo-terminals.
        model: of the line scanner.
        unit_baud: bits a second of the unit's port.
        bench: the room; None: made of `scene` and `seed`.

    Attributes:
        bench: the room, with the true mounts.
        unit: the pan/tilt unit.
        scanner: the line scanner.
        server: their ports.
    """

    def __init__(
        self, scene: str = "office", seed: int = 0, *, sockets: bool = False, model: ScipModel = UTM_30LX,
        unit_baud: int = 115_200, bench: Bench | None = None,
    ) -> None:  # fmt: skip
        self.bench = Bench(scene, seed) if bench is None else bench
        self.unit = FlirTwin(baud=unit_baud, seed=seed)
        self.scanner = ScipTwin(self._measure, model=model, seed=seed)
        self.server = TwinServer([self.unit, self.scanner], sockets=sockets)
        self._control: socket.socket | None = None

    def __enter__(self) -> TwinDevices:
        self.server.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._control is not None:
            self._control.close()
        self.server.__exit__(kind, error, trace)

    @property
    def addresses(self) -> dict[str, str]:
        """Address of each device, by its name."""
        return self.server.addresses

    def state(self) -> dict[str, Any]:
        """Return whether the laser is on and the unit moves, and where it is, deg."""
        now = self.server.now_s()
        pan, tilt = np.degrees(self.unit.angles_at([now])[0])
        return {"laser_on": self.scanner.laser_on, "moving": self.unit.moving(now), "pan_deg": pan, "tilt_deg": tilt}

    def fail(self, device: str, kind: str) -> None:
        """Have a device fail.

        Args:
            device: its name.
            kind: of both: unplugged, plugged, silent, rubbish, none; of the unit: stuck, limit; of the scanner:
                `wrong checksum`, `lost line`, `truncated`.

        Raises:
            OptionError: if there is no such device or failure.
        """
        now = self.server.now_s()
        if device not in self.addresses:
            raise OptionError(f"there is no device {device!r}; use {' or '.join(self.addresses)}")
        if kind in ("unplugged", "plugged"):
            (self.server.unplug if kind == "unplugged" else self.server.plug)(device)
        elif device == self.unit.name and kind in ("silent", "rubbish", "stuck", "limit", "none"):
            self.unit.silent, self.unit.rubbish, self.unit.stuck = (kind == k for k in ("silent", "rubbish", "stuck"))
            if kind == "limit":
                self.unit.hit_limit("P", now)
        elif device == self.scanner.name and kind in (
            "silent", "rubbish", "wrong checksum", "lost line", "truncated", "none",
        ):  # fmt: skip
            self.scanner.failure = None if kind == "none" else kind  # type: ignore[assignment]
        else:
            raise OptionError(f"the device {device} does not fail by {kind!r}")

    def listen(self) -> int:
        """Serve `state` and `fail` to other processes, as JSON lines; return the port on this machine."""
        self._control = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._obey_all, args=(self._control,), daemon=True).start()
        return int(self._control.getsockname()[1])

    def _obey_all(self, listening: socket.socket) -> None:
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=self._obey, args=(connection,), daemon=True).start()

    def _obey(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rw", encoding="utf-8") as stream:
            for line in stream:
                try:
                    message = json.loads(line)
                    if "fail" in message:
                        self.fail(str(message["fail"]), str(message["kind"]))
                    answer: dict[str, Any] = self.state()
                except (ValueError, KeyError, TypeError, OptionError) as error:
                    answer = {"error": str(error)}
                stream.write(json.dumps(answer) + "\n")
                stream.flush()

    def _measure(
        self, angles: NDArray[np.float64], times: NDArray[np.float64], number: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Measure a line from where the unit is at the time of each ray."""
        pan, tilt = self.unit.angles_at(times).T
        if np.ptp(pan) < _AT_REST_RAD and np.ptp(tilt) < _AT_REST_RAD:
            # A resumed run measures the same: the noise is that of the position, not of the moment.
            key = [round(pan[0] * COUNTS_PER_RAD), round(tilt[0] * COUNTS_PER_RAD), number]
            ranges, light = self.bench.scan_line(PanTilt(float(pan[0]), float(tilt[0])), angles, noise_key=key)
        else:
            ranges, light = self.bench.scan_line((pan, tilt), angles, noise_key=[round(times[0] * 1e6), number])
        return ranges, light * np.float32(_INTENSITY)
