"""Simulated devices in one room, behind real ports and in real folders.

Tests, demonstrations and `twin:` addresses connect to them.
"""

from __future__ import annotations

import json
import socket
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.flir_twin import COUNTS_PER_RAD, FlirTwin
from ladarreg_core.acquisition.simulated.folder_twin import FRAME, FolderTwin, ScanFormat, camera_twin, scanner_twin
from ladarreg_core.acquisition.simulated.lidar_twin import LidarTwin, VelodyneOnBench
from ladarreg_core.acquisition.simulated.onvif_twin import OnvifServer, OnvifTwin
from ladarreg_core.acquisition.simulated.pelco_twin import PelcoTwin
from ladarreg_core.acquisition.simulated.scip_twin import UTM_30LX, ScipFailure, ScipModel, ScipTwin
from ladarreg_core.acquisition.simulated.server import DeviceServer, TwinServer
from ladarreg_core.acquisition.simulated.twin import Twin
from ladarreg_core.acquisition.simulated.world import Angles, Bench
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scanner.grids import ScanGeometry

SCANNER, CAMERA = "scanner", "camera"
"""Names of the devices with folders."""
LIDAR = "velodyne"
"""Name of the spinning lidar that sends packets."""
_INTENSITY = 2000.0
_AT_REST_RAD = 1e-9
_DELAY_S = 0.5  # whoever drives the unit is to learn of its arrival before a file is written


class TwinDevices:
    """A pan/tilt unit in a simulated room, and on it a line scanner, a scanner with a field of view, a camera and a
    spinning lidar; a context manager.

    Scanner and camera write into folders when the unit has arrived, and the lidar sends packets, after they were
    switched on.

    Args:
        scene: the room.
        seed: of room, mounts and noise.
        serve: gives the unit and the line scanner their ports; by default real ones, in real time.
        model: of the line scanner.
        unit_baud: bits a second of the unit's port.
        bench: the room; None: made of `scene` and `seed`.
        geometry: rays of the scanner with a field of view.
        scan_format: of its files.
        folders: existing folders of scanner and camera by their names, `SCANNER` and `CAMERA`; those that are not
            given are temporary.

    Attributes:
        bench: the room, with the true mounts.
        unit: the pan/tilt unit.
        pelco, onvif: controllers of the same unit by other protocols; one at a time is used.
        scanner: the line scanner.
        server: their ports.
        lidar: the spinning lidar.
    """

    def __init__(
        self, scene: str = "office", seed: int = 0, *, serve: Callable[[Sequence[Twin]], DeviceServer] = TwinServer,
        model: ScipModel = UTM_30LX, unit_baud: int = 115_200, bench: Bench | None = None,
        geometry: ScanGeometry = FRAME, scan_format: ScanFormat = "npz", folders: Mapping[str, Path] | None = None,
    ) -> None:  # fmt: skip
        self.bench = Bench(scene, seed) if bench is None else bench
        self.unit = FlirTwin(baud=unit_baud, seed=seed, moved=self._moved)
        self.scanner = ScipTwin(self._measure, model=model, seed=seed)
        self.pelco = PelcoTwin(self.unit, baud=unit_baud)
        self.onvif = OnvifTwin(self.unit)
        self.server = serve([self.unit, self.scanner, self.pelco])
        self._onvif_server = OnvifServer(self.onvif, self.server.now_s)
        self.bench.clock = self.server.now_s
        self._geometry, self._scan_format, self._given_folders = geometry, scan_format, dict(folders or {})
        self._folders: dict[str, FolderTwin] = {}
        lidar = VelodyneOnBench(self.bench)
        self.lidar = LidarTwin(lidar.packets, seconds=1.0 / lidar.rate_hz, clock=self.server.clock)
        self._inside = ExitStack()
        self._control: socket.socket | None = None

    def __enter__(self) -> TwinDevices:
        with ExitStack() as entered:
            above = Path(entered.enter_context(tempfile.TemporaryDirectory(prefix="ladarreg-twin-")))
            where = {name: self._given_folders.get(name, above / name) for name in (SCANNER, CAMERA)}
            for folder in where.values():
                folder.mkdir(exist_ok=True)
            twins = {
                SCANNER: scanner_twin(
                    self.bench,
                    where[SCANNER],
                    geometry=self._geometry,
                    file_format=self._scan_format,
                    delay_s=_DELAY_S,
                    clock=self.server.clock,
                ),
                CAMERA: camera_twin(self.bench, where[CAMERA], delay_s=_DELAY_S, clock=self.server.clock),
            }
            for name, twin in twins.items():
                twin.on = False  # a sweep would be slowed down by photographs that nobody asked for
                self._folders[name] = entered.enter_context(twin)
            entered.enter_context(self.server)
            entered.enter_context(self._onvif_server)
            entered.enter_context(self.lidar)
            self._inside = entered.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._control is not None:
            self._control.close()
        self._inside.close()

    @property
    def addresses(self) -> dict[str, str]:
        """Port or folder of each device, by its name; of the head with ONVIF, its URL; of the lidar, the host and the
        UDP port that it sends to."""
        folders = {name: str(twin.folder) for name, twin in self._folders.items()}
        by_network = {self.onvif.name: self._onvif_server.url, LIDAR: f"127.0.0.1:{self.lidar.port}"}
        return {**self.server.addresses, **folders, **by_network}

    def switch_on(self, device: str) -> None:
        """Switch on a device that writes into a folder, or the lidar.

        Raises:
            OptionError: if there is no such device.
        """
        if device == LIDAR:
            self.lidar.switch_on()
            return
        if device not in self._folders:
            raise OptionError(f"there is no device {device!r} with a folder; use {' or '.join(self._folders)}")
        self._folders[device].on = True

    def state(self) -> dict[str, Any]:
        """Return whether the laser is on and the unit moves, where it is, deg, and the files written, by device."""
        now = self.server.now_s()
        pan, tilt = np.degrees(self.unit.angles_at([now])[0])
        files = {name: twin.written for name, twin in self._folders.items()}
        return {"laser_on": self.scanner.laser_on, "moving": self.unit.moving(now), "pan_deg": pan, "tilt_deg": tilt,
                "files": files}  # fmt: skip

    def fail(self, device: str, kind: str) -> None:
        """Have a device fail.

        Args:
            device: its name.
            kind: `none` ends all failures; of devices with ports: unplugged, plugged; of the unit, by whatever
                protocol: silent, rubbish, stuck; of the unit: limit; of the line scanner: `ScipFailure`; of the next
                file in a folder: `FileFailure`.

        Raises:
            OptionError: if there is no such device or failure.
        """
        now = self.server.now_s()
        if device not in self.addresses:
            raise OptionError(f"there is no device {device!r}; use {' or '.join(self.addresses)}")
        if device == LIDAR and kind == "none":
            return  # it has no failures of its own
        if device in self._folders and kind == "none":
            self._folders[device].mend()
        elif device in self._folders:
            self._folders[device].fail(kind)  # type: ignore[arg-type]
        elif kind in ("unplugged", "plugged") and device in self.server.addresses:
            (self.server.unplug if kind == "unplugged" else self.server.plug)(device)
        elif device in (self.pelco.name, self.onvif.name) and kind in ("silent", "rubbish", "stuck", "none"):
            head = self.pelco if device == self.pelco.name else self.onvif
            head.silent, head.rubbish, self.unit.stuck = (kind == k for k in ("silent", "rubbish", "stuck"))
        elif device == self.unit.name and kind in ("silent", "rubbish", "stuck", "limit", "none"):
            self.unit.silent, self.unit.rubbish, self.unit.stuck = (kind == k for k in ("silent", "rubbish", "stuck"))
            if kind == "limit":
                self.unit.hit_limit("P", now)
        elif device == self.scanner.name and kind in (*get_args(ScipFailure), "none"):
            self.scanner.failure = None if kind == "none" else kind  # type: ignore[assignment]
        else:
            raise OptionError(f"the device {device} does not fail by {kind!r}")

    def obey(self, request: str) -> dict[str, Any]:
        """Do what a JSON object asks: `{"switch_on": name}`, `{"fail": name, "kind": kind}`, or nothing.

        Returns:
            The state, or `{"error": text}`.
        """
        try:
            message = json.loads(request)
            if "switch_on" in message:
                self.switch_on(str(message["switch_on"]))
            if "fail" in message:
                self.fail(str(message["fail"]), str(message["kind"]))
        except (ValueError, KeyError, TypeError, OptionError) as error:
            return {"error": str(error)}
        return self.state()

    def listen(self) -> int:
        """Obey other processes, which send requests and get answers as lines; return the port on this machine."""
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
                answer = self.obey(line)
                stream.write(json.dumps(answer) + "\n")
                stream.flush()

    def _moved(self, now_s: float, arrives: bool) -> None:
        def motion(times_s: FloatArray) -> Angles:
            pan, tilt = self.unit.angles_at(times_s).T
            return pan, tilt

        self.bench.publish_motion(motion, from_s=now_s, rest_s=self.unit.rest_s, arrives=arrives)

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
