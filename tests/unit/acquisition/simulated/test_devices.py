"""All twins in one room: drivers and folders give what is true where the unit stands."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

import ladarreg_core as lr
from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.plan import ScannerPlan, UnitPlan
from ladarreg_core.acquisition.plan_reading import plan_from_fields
from ladarreg_core.acquisition.runs.run_folder import ScanPiece
from ladarreg_core.acquisition.simulated.devices import CAMERA, SCANNER, TwinDevices
from ladarreg_core.acquisition.simulated.folder_twin import CAMERA as CAMERA_MODEL
from ladarreg_core.acquisition.simulated.folder_twin import FRAME
from ladarreg_core.acquisition.simulated.world import FRAME_MOUNT, Bench
from ladarreg_core.acquisition.twin_address import watched_folder
from ladarreg_core.errors import DeviceError, OptionError
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.devices.runs import recorded_pieces
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer

GEOMETRY = AzimuthElevation(35, 50, np.radians(1.1), np.radians(1.1))


def goes_on() -> None:
    pass


@pytest.fixture(scope="module")
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture(scope="module")
def devices(clock: SimulatedClock) -> Iterator[TwinDevices]:
    with TwinDevices("plain", 1, geometry=GEOMETRY, serve=partial(MemoryServer, clock=clock)) as served:
        yield served


@pytest.fixture(scope="module")
def unit(devices: TwinDevices) -> Iterator[FlirUnit]:
    with MemoryPorts(devices.server) as ports:
        yield FlirUnit.connect(ports, UnitPlan(devices.addresses["flir-ptu"], baud=devices.unit.baud))


def test_lines_are_true_where_the_unit_stands_and_the_same_when_it_is_back(
    devices: TwinDevices, unit: FlirUnit
) -> None:
    with MemoryPorts(devices.server) as ports:
        scanner = ScipScanner.connect(ports, ScannerPlan("scip2", port=devices.addresses["scip2"]))
        at = unit.move_to(PanTilt(0.2, -0.1), check=goes_on)
        assert not devices.bench.moving
        assert devices.bench.pose_at(devices.bench.now()) == PanTilt(
            pytest.approx(at.pan_rad, abs=1e-9), pytest.approx(at.tilt_rad, abs=1e-9)
        )
        first, again = scanner.lines(2, check=goes_on)
        assert not devices.scanner.laser_on
        error = first.ranges_m - devices.bench.true_line(at, scanner.identity.angles_rad)
        assert np.nanmedian(np.abs(error)) < 0.003
        assert not np.array_equal(first.ranges_m, again.ranges_m)
        unit.move_to(PanTilt(0.25, 0.0), check=goes_on)
        unit.move_to(PanTilt(0.2, -0.1), check=goes_on)
        (back,) = scanner.lines(1, check=goes_on)
        assert np.array_equal(back.ranges_m, first.ranges_m, equal_nan=True)


@pytest.mark.slow
def test_files_appear_when_the_unit_has_arrived_and_not_when_it_was_halted(
    devices: TwinDevices, unit: FlirUnit, clock: SimulatedClock
) -> None:
    def written(name: str) -> int:
        return int(devices.state()["files"][name])

    unit.move_to(PanTilt(0.0, 0.0), check=goes_on)
    clock.sleep(0.5)
    assert written(SCANNER) == written(CAMERA) == 0, "they are switched off"
    for name in (SCANNER, CAMERA):
        devices.switch_on(name)
    unit.start_move(PanTilt(1.0, 0.0))
    assert clock.wait_until(lambda: devices.bench.moving, 1.0)
    unit.halt()
    assert clock.wait_until(lambda: not devices.bench.moving, 1.0)
    clock.sleep(0.5)
    assert written(SCANNER) == 0
    at = unit.move_to(PanTilt(0.1, 0.05), check=goes_on)
    assert clock.wait_until(lambda: written(SCANNER) == written(CAMERA) == 1, 5.0)
    (scan,) = [lr.read_scan(path) for path in sorted(Path(devices.addresses[SCANNER]).glob("*.npz"))[-1:]]
    key = tuple(round(angle / 1e-5) for angle in (at.pan_rad, at.tilt_rad))
    true = devices.bench.scan_frame(at, GEOMETRY, noise_key=key)
    assert np.allclose(scan.points, true.points, atol=1e-5, equal_nan=True)
    photo = cv2.imread(str(max(Path(devices.addresses[CAMERA]).glob("*.jpg"))))
    assert photo.shape == (512, 768, 3)


def test_folders_fail_in_their_own_ways_only(devices: TwinDevices) -> None:
    for device, kind in ((SCANNER, "unplugged"), ("flir-ptu", "two-files"), ("hinge", "never")):
        with pytest.raises(OptionError):
            devices.fail(device, kind)


@pytest.mark.slow  # in real time: the devices have a process of their own
def test_a_mosaic_is_recorded_by_the_addresses_of_twins(tmp_path: Path) -> None:
    at = "?seed=3&scene=plain"
    fields = {
        "version": 1,
        "unit": {"port": f"twin:flir-ptu{at}", "baud": 115200},
        "scanner": {"kind": "folder", "folder": f"twin:scanner{at}", "timeout_s": 120},
        "camera": {"folder": f"twin:camera{at}"},
        "mode": "mosaic",
        "pan_deg": [0, 40, 40],
        "tilt_deg": [0, 0, 0],
        "mount": {"xyz_m": FRAME_MOUNT.translation.tolist(), "rpy_deg": [0, 0, 0]},
    }
    bench = Bench("plain", 3)
    pieces = recorded_pieces(fields, tmp_path / "run")
    assert len(pieces) == 2
    for piece in pieces:
        assert isinstance(piece, ScanPiece)
        key = tuple(round(angle / 1e-5) for angle in (piece.at.pan_rad, piece.at.tilt_rad))
        true = bench.scan_frame(piece.at, FRAME, noise_key=key)
        assert np.allclose(piece.scan.points, true.points, atol=1e-4, equal_nan=True)
    photos = [lr.read_photo(path) for path in sorted((tmp_path / "run" / "photos").iterdir())]
    assert [photo.camera.fx for photo in photos] == [CAMERA_MODEL.fx] * 2
    assert np.abs(photos[0].pixels.astype(float) - photos[1].pixels).mean() > 10
    with pytest.raises(OptionError, match="'folder' of 'camera'"):
        plan_from_fields({**fields, "camera": {"folder": "twin:camera?colour=red"}})
    with pytest.raises(DeviceError, match="writes no files"):
        watched_folder(f"twin:scip2{at}")
