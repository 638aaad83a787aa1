"""Real scans: upright, not mirrored, and at their surveyed positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.formats import describe, extract_images, read_photo, read_scan
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import PinholeGrid


def assert_upright(scan: Scan) -> None:
    """Row 0 is the top, column 0 the left; ranges are measured along the cells' rays."""
    down = np.diff(np.arcsin(scan.rays[..., 2]), axis=0)
    longitude = np.arctan2(scan.rays[..., 1], scan.rays[..., 0])
    right = (np.diff(longitude, axis=1) + np.pi) % (2 * np.pi) - np.pi
    assert np.mean(down < 0) > 0.99
    assert np.mean(right < 0) > 0.99
    np.testing.assert_allclose(np.linalg.norm(scan.points[scan.valid], axis=-1), scan.ranges[scan.valid], rtol=1e-5)


def test_kinect(real_data: Path) -> None:
    scan = read_scan(real_data / "kinect" / "scan.json")
    assert scan.shape == (576, 640)
    assert isinstance(scan.geometry, PinholeGrid)
    assert_upright(scan)
    assert scan.valid.sum() == 281_945


@pytest.mark.slow
def test_pump(real_data: Path, tmp_path: Path) -> None:
    path = real_data / "pump" / "pumpAVisualReferenceImage.e57"
    scan = read_scan(path)
    assert scan.shape == (1074, 345)
    assert scan.valid.sum() == 155_201
    assert_upright(scan)
    np.testing.assert_allclose([np.nanmin(scan.ranges), np.nanmax(scan.ranges)], [1.983619, 5.429336], atol=1e-5)
    low, high = scan.intensity[scan.valid].min(), scan.intensity[scan.valid].max()
    np.testing.assert_allclose([low, high], [0.384, 0.698], atol=1e-3)
    assert scan.color is not None
    assert "3072 x 2304" in describe(path).images[0]
    (picture,) = extract_images(path, tmp_path)
    assert read_photo(picture.picture, focal_px=3000).pixels.shape == (2304, 3072, 3)


def test_garage_with_a_wrong_header(real_data: Path) -> None:
    cloud, grid = read_scan(real_data / "garage" / "pointcloud9.pcd"), read_scan(real_data / "garage" / "scan.npz")
    assert cloud.shape == grid.shape == (64, 1024)
    for scan in (cloud, grid):
        assert_upright(scan)

    def ordered(scan: Scan) -> np.ndarray:
        points = scan.points[scan.valid]
        return np.asarray(points[np.lexsort(points.T)])

    np.testing.assert_allclose(ordered(cloud), ordered(grid), atol=1e-4)


@pytest.mark.slow
def test_street_keeps_its_points(real_data: Path) -> None:
    scan = read_scan(real_data / "street" / "scan.pcd")
    assert scan.shape == (64, 1800)
    assert_upright(scan)
    assert scan.valid.sum() > 0.99 * 85_546


def test_every_camera_and_pose_is_read(real_data: Path) -> None:
    for path in sorted(real_data.glob("*/camera.json")):
        assert describe(path).kind == "camera"
    for path in sorted(real_data.glob("*/truth.json")):
        assert abs(np.linalg.det(read_pose(path).rotation) - 1) < 1e-9
    photo = read_photo(real_data / "garage" / "frame9.png", camera=real_data / "garage" / "camera.json")
    assert photo.camera.size == (1920, 1200)
