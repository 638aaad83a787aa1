"""Simulated scanners and cameras that write files: formats, ways of writing, failures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

import ladarreg_core as lr
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.folder_twin import ScanFormat, camera_twin, scanner_twin
from ladarreg_core.acquisition.simulated.world import Angles, Bench
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.devices.simulated_clock import SimulatedClock

GEOMETRY = AzimuthElevation(35, 50, np.radians(1.1), np.radians(1.1))


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.mark.parametrize("file_format", ["npz", "ptx", "e57"])
def test_scans_of_every_format_are_read_as_they_were_measured(
    tmp_path: Path, file_format: ScanFormat, clock: SimulatedClock
) -> None:
    if file_format == "e57":
        pytest.importorskip("pye57")
    b = Bench("boxes", 1, clock=clock.now)
    with scanner_twin(
        b, tmp_path, geometry=GEOMETRY, file_format=file_format, delay_s=0, writing_s=0.02, clock=clock
    ) as twin:
        b.place_unit(PanTilt(0.3, 0.1))
        assert clock.wait_until(lambda: twin.written == 1, 5)
    (file,) = tmp_path.iterdir()
    scan, true = lr.read_scan(file), b.scan_frame(PanTilt(0.3, 0.1), GEOMETRY, noise_key=(30_000, 10_000))
    returned = np.isfinite(true.ranges)
    assert scan.shape == GEOMETRY.shape
    assert np.array_equal(np.isfinite(scan.ranges), returned)
    assert np.allclose(scan.points[returned], true.points[returned], atol=2e-4)
    assert correlation(scan, true, returned) > 0.99


def correlation(scan: Scan, true: Scan, where: np.ndarray) -> float:
    return float(np.corrcoef(scan.intensity[where], np.minimum(true.intensity, 4)[where])[0, 1])


def test_files_come_in_several_ways_and_fail_on_request(tmp_path: Path, clock: SimulatedClock) -> None:
    b = Bench("boxes", 1, clock=clock.now)
    small = lr.Camera.from_focal(64, 48, 50.0)
    seen: dict[str, set[int]] = {}
    with camera_twin(b, tmp_path, camera=small, file_format="png", delay_s=0, clock=clock) as twin:

        def place() -> None:
            b.place_unit(PanTilt(0.1, 0.0))

        def look() -> None:
            for path in tmp_path.iterdir():
                seen.setdefault(path.name, set()).add(path.stat().st_size)

        for number in range(1, 7):
            place()
            until = clock.now() + 5
            while twin.written < number and clock.now() < until:
                look()
                clock.sleep(0.002)
        assert twin.written == 6
        assert any(name.endswith(".part") for name in seen), "none under a temporary name"
        assert any(len(sizes) > 2 for name, sizes in seen.items() if name.endswith(".png")), "none grew"
        whole = sorted(tmp_path.iterdir())
        assert len({path.read_bytes() for path in whole}) == 1, "the same position gives the same picture"

        twin.fail("two-files")
        twin.mend()
        for kind in ("never", "truncated", "wrong-format", "two-files"):
            twin.fail(kind)  # type: ignore[arg-type]
        place()
        clock.sleep(0.3)
        assert len(list(tmp_path.iterdir())) == 6
        for total in (7, 8, 10):
            place()
            assert clock.wait_until(lambda n=total: len(list(tmp_path.glob("*.png"))) == n, 5)
            clock.sleep(0.4)
    contents = [path.read_bytes() for path in sorted(tmp_path.iterdir())][6:]
    good = whole[0].read_bytes()
    assert contents[0] == good[: len(good) * 2 // 3]
    assert not contents[1].startswith(good[:4])
    assert contents[2] == contents[3] == good


def test_a_unit_that_was_halted_or_is_sent_elsewhere_meanwhile_gives_no_file(
    tmp_path: Path, clock: SimulatedClock
) -> None:
    now = [0.0]
    b = Bench("boxes", 1, clock=lambda: now[0])

    def rest(times: FloatArray) -> Angles:
        return 0 * times, 0 * times

    with scanner_twin(b, tmp_path, geometry=GEOMETRY, delay_s=0.1, writing_s=0.02, clock=clock) as twin:
        b.publish_motion(rest, from_s=0.0, rest_s=1.0)
        now[0] = 0.5
        b.publish_motion(rest, from_s=0.5, rest_s=0.5, arrives=False)
        now[0] = 2.0
        clock.sleep(0.1)
        b.publish_motion(rest, from_s=2.0, rest_s=3.0)
        now[0] = 2.9
        b.publish_motion(rest, from_s=2.9, rest_s=4.0)
        now[0] = 3.5
        clock.sleep(0.1)
        assert list(tmp_path.iterdir()) == []
        now[0] = 4.2
        assert clock.wait_until(lambda: twin.written == 1, 5)
