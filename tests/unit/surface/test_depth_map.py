"""Depth at pixels, against planes whose depth is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.visibility import depth_map as module
from ladarreg_core.surface.visibility.depth_map import depth_map

WALL_M, BOX_M = 4.0, 2.5
POSE = Rigid.from_rotvec((0.05, -0.1, 0.2)) @ Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.2, 0.3, -0.1))
CAMERAS = {
    "pinhole": Camera(200, 150, 180.0, 182.0, 99.0, 76.0),
    "distorted": Camera(200, 150, 180.0, 182.0, 99.0, 76.0, (-0.25, 0.06, 0.002, -0.001, 0.01)),
    "fisheye": FisheyeCamera(200, 200, 62.0, 62.0, 99.5, 99.5, (0.01, -0.002, 0.0, 0.0)),
    "equirectangular": EquirectangularCamera(400, 200),
}


def room() -> Scan:
    geometry = AzimuthElevation(180, 240, 0.005, 0.005)
    ranges = WALL_M / geometry.rays[..., 0]
    ranges[70:110, 100:140] = BOX_M / geometry.rays[70:110, 100:140, 0]
    return Scan(geometry, ranges, np.ones(geometry.shape))


def expected(camera: CameraModel, uv: np.ndarray, plane_m: float) -> np.ndarray:
    """Depth of the plane x = plane_m along each pixel's ray, from the truth."""
    rays = camera.unproject(uv)
    in_scanner = rays @ POSE.rotation
    t = (plane_m - POSE.centre[0]) / in_scanner[..., 0]
    t[t <= 0] = np.nan
    return t * (rays[..., 2] if isinstance(camera, Camera) else 1)


@pytest.mark.parametrize("name", CAMERAS)
def test_pixels_have_the_depth_of_the_plane_behind_them(name: str) -> None:
    camera = CAMERAS[name]
    found = depth_map(room(), camera, POSE)
    v, u = np.mgrid[: camera.height, : camera.width]
    uv = np.stack([u, v], axis=-1).astype(float)
    with np.errstate(invalid="ignore"):
        wall, box = (np.abs(found / expected(camera, uv, plane) - 1) for plane in (WALL_M, BOX_M))
        seen = np.isfinite(found)
        assert seen.sum() > 1500
        assert (np.fmin(wall, box)[seen] < 1e-4).mean() > 0.98, "all but some at the box's edges"
        assert np.fmin(wall, box)[seen].max() < 0.01, "these have the depth of a place half a pixel away"
        assert (box < 1e-4).sum() > 100, "the box is there"
        shifted = np.abs(found / expected(camera, uv + np.array([0.5, 0]), WALL_M) - 1)
    assert (shifted[seen & (wall < 1e-4)] > 1e-4).mean() > 0.5, "half a pixel would be noticed"


def test_a_picture_in_bands_and_a_scan_in_parts_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = CAMERAS["pinhole"]
    whole = depth_map(room(), camera, POSE)
    monkeypatch.setattr(module, "_MAX_PIXELS", 200 * 40)
    monkeypatch.setattr(module, "LARGEST_WHOLE_SCAN", 1000)
    banded = depth_map(room(), camera, POSE)
    assert (np.isfinite(whole) == np.isfinite(banded)).mean() > 0.999
    both = np.isfinite(whole) & np.isfinite(banded)
    assert np.abs(whole - banded)[both].max() < 2e-4
