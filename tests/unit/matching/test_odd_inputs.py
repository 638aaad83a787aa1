"""Unusual inputs: small photos, coarse scans, rolled cameras, and images without features."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import rotation_from_rotvec
from ladarreg_core.matching.features.correlation import windows_at
from ladarreg_core.matching.features.descriptors import describe
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.registration.register import register
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


def resized(photo: lr.Photo, width: int, height: int) -> lr.Photo:
    pixels = cv2.resize(photo.pixels, (width, height), interpolation=cv2.INTER_AREA)
    return lr.Photo(pixels, photo.camera.resized(width, height))


@pytest.mark.parametrize(("width", "height"), [(300, 212), (230, 163)])
def test_a_small_photo_has_enough_regions(room: PaintedRoom, width: int, height: int) -> None:
    small = resized(room.photo, width, height)
    result = register(room.scan, small)
    assert result.accepted, result.reasons
    assert room.error_px(result.camera_from_scanner) < 0.6


def test_a_coarse_scan_is_not_interpolated(room: PaintedRoom) -> None:
    fine = room.scan
    geometry = AzimuthElevation(150, 210, np.deg2rad(0.22), np.deg2rad(0.22), np.deg2rad(0.055), np.deg2rad(0.055))
    np.testing.assert_allclose(geometry.rays, fine.rays[::2, ::2], atol=1e-12)
    coarse = lr.Scan(geometry, fine.ranges[::2, ::2], fine.intensity[::2, ::2])
    result = register(coarse, room.photo)
    assert room.error_px(result.camera_from_scanner) < 0.7
    of_fine = register(fine, room.photo).diagnostics["verification"]["windows"]
    assert result.diagnostics["verification"]["windows"] < 0.6 * of_fine, "with blocks that are less than half as large"
    verdict = result.diagnostics["verification"]
    assert not result.accepted or verdict["by_few"] or verdict["fraction"] >= 0.75, "few regions, of which most agree"


def test_the_working_camera_has_the_coarser_resolution(room: PaintedRoom) -> None:
    native = 1 / min(room.scan.geometry.step_rad)
    for width, height, focal in ((480, 340, 400.0), (4000, 3000, 5000.0), (320, 240, 300.0), (768, 512, 3400.0)):
        camera = lr.Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
        working = working_camera(room.scan, camera)
        assert working.width * working.height <= 1.01e6
        assert working.focal_px <= 1.01 * max(native, 1.0)
        if working.focal_px > 1.01 * focal:  # enlarged, but no further than needed
            assert working.focal_px <= 2.02 * focal
            assert working.width * working.height <= 1.65e5
        assert photo_levels(resized(room.photo, 64, 48), working_camera(room.scan, camera.resized(64, 48))).gray.any()


@pytest.mark.parametrize("turn_deg", [90, 180])
def test_a_rolled_photo_registers_from_an_initial_pose(room: PaintedRoom, turn_deg: int) -> None:
    quarter_turns = turn_deg // 90
    camera = room.photo.camera
    turned_camera = camera if turn_deg == 180 else lr.Camera(width=340, height=480, fx=520, fy=520, cx=169.5, cy=239.5)
    pixels = np.ascontiguousarray(np.rot90(room.photo.pixels, -quarter_turns))
    turn = lr.Rigid(rotation_from_rotvec([0, 0, np.deg2rad(turn_deg)]), np.zeros(3))
    near = rotation_from_rotvec([0.02, -0.03, 0.03])
    truth = turn @ room.camera_from_scanner
    rough = lr.Rigid(near @ truth.rotation, truth.translation + 0.03)
    result = register(room.scan, lr.Photo(pixels, turned_camera), initial=rough)
    assert result.accepted, result.reasons
    assert room.error_px(turn.inverse @ result.camera_from_scanner) < 0.5


@pytest.mark.slow
def test_photos_without_corners_are_refused_with_reasons(room: PaintedRoom) -> None:
    halves = np.zeros((340, 480, 3), np.uint8)
    halves[:, 240:] = 200
    dot = np.zeros_like(halves)
    dot[170, 240] = 255
    for pixels in (halves, dot):
        result = register(room.scan, lr.Photo(pixels, room.photo.camera))
        assert not result.accepted
        assert result.reasons
    assert describe(np.ones((20, 20, 8), np.float32), np.zeros((0, 2))).shape == (0, 392)
    assert windows_at(np.ones((20, 20), np.float32), np.zeros((0, 2))).shape == (0, 225)


def test_rays_that_do_not_spread_are_refused(room: PaintedRoom) -> None:
    class Narrow:
        def __init__(self, geometry: object) -> None:
            self._geometry = geometry
            self.step_rad = (0.0, 1e-3)

        def __getattr__(self, name: str) -> object:
            return getattr(self._geometry, name)

    scan = lr.Scan(Narrow(room.scan.geometry), room.scan.ranges, room.scan.intensity)
    with pytest.raises(DegenerateGeometryError, match="spread"):
        perspective_view(scan)
