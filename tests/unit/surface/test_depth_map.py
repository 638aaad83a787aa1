"""Depth at pixels, against planes whose depth is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import ShapeError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface import depth_map as module
from ladarreg_core.surface.depth_map import depth_at, depth_map

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


@pytest.mark.parametrize("name", CAMERAS)
def test_positions_agree_with_the_plane_between_pixels_too(name: str) -> None:
    camera = CAMERAS[name]
    rng = np.random.default_rng(2)
    uv = rng.uniform(0, np.array(camera.size) - 1, (300, 2))
    found = depth_at(room(), camera, POSE, uv)
    whole = depth_map(room(), camera, POSE)
    near = whole[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)]
    assert (np.isfinite(found) == np.isfinite(near)).mean() > 0.95
    seen = np.isfinite(found)
    off = np.fmin(*(np.abs(found / expected(camera, uv, plane) - 1) for plane in (WALL_M, BOX_M)))
    assert seen.sum() > 10
    assert off[seen].max() < 1e-6


def test_a_picture_in_bands_and_a_scan_in_parts_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = CAMERAS["pinhole"]
    whole = depth_map(room(), camera, POSE)
    monkeypatch.setattr(module, "_MOST_PIXELS", 200 * 40)
    monkeypatch.setattr(module, "LARGEST_WHOLE_SCAN", 1000)
    banded = depth_map(room(), camera, POSE)
    assert (np.isfinite(whole) == np.isfinite(banded)).mean() > 0.999
    both = np.isfinite(whole) & np.isfinite(banded)
    assert np.abs(whole - banded)[both].max() < 2e-4


def test_positions_outside_have_no_depth() -> None:
    camera = CAMERAS["pinhole"]
    assert np.isnan(depth_at(room(), camera, POSE, np.array([[-20.0, 10], [np.nan, 3]]))).all()
    assert len(depth_at(room(), camera, POSE, np.zeros((0, 2)))) == 0
    with pytest.raises(ShapeError, match=r"\(N, 2\)"):
        depth_at(room(), camera, POSE, np.zeros(2))


@pytest.mark.parametrize("name", CAMERAS)
def test_what_the_photograph_cannot_show_is_left_out_on_request(name: str) -> None:
    camera = CAMERAS[name]
    whole, seen = (depth_map(room(), camera, POSE, only_seen=only) for only in (False, True))
    kept = np.isfinite(seen)
    assert np.array_equal(seen[kept], whole[kept])
    assert 0.97 < kept.sum() / np.isfinite(whole).sum() < 1, "but for the margin of the box"
    behind = Rigid.from_centre(look_along([-1.0, 0.0, 0.02]), (3.5, 0.0, 0.0))  # between box and wall: the box's back
    assert np.isfinite(depth_map(room(), camera, behind)).sum() > 500
    backs = depth_map(room(), camera, behind, only_seen=True)
    if not isinstance(camera, Camera):  # the wall is seen, too, beside and behind the camera
        v, u = np.nonzero(np.isfinite(backs))
        x = (camera.unproject(np.stack([u, v], axis=-1)) * backs[v, u, None]) @ behind.rotation[:, 0] + 3.5
        assert np.abs(x - WALL_M).max() < 0.05
    else:
        assert not np.isfinite(backs).any()
