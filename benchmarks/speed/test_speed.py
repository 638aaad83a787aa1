"""The core's parts, timed by pytest-benchmark: `pytest benchmarks --benchmark-enable`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER
from ladarreg_core.pose.estimators.ransac import ransac_pose
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate import sample_folder
from ladarreg_core.surface.texture.registered_texture import texture_scan

CAMERA = lr.Camera.from_focal(768, 512, 974.0)
POSE = lr.Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.4, 0.1))


@pytest.fixture(scope="module")
def sample() -> tuple[lr.Scan, lr.Photo]:
    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    return scan, lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json")


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    scanner = np.column_stack([rng.uniform(2, 6, 200), rng.uniform(-1, 1, 200), rng.uniform(-0.8, 0.8, 200)])
    uv = CAMERA.project(POSE @ scanner) + rng.normal(0, 1, (200, 2))
    uv[:60] = rng.uniform(0, 1, (60, 2)) * CAMERA.size
    return scanner, uv


def test_perspective_view(benchmark: Any) -> None:
    step = np.deg2rad(0.055)
    scan = lr.Scan(AzimuthElevation(700, 1000, step, step), np.full((700, 1000), 3.0), np.ones((700, 1000)))
    view = benchmark(lambda: lr.perspective_view(scan, lr.Camera.from_focal(1152, 868, 1000.0)))
    assert view.inside.mean() > 0.5


def test_ransac_200_points(benchmark: Any, points: tuple[np.ndarray, np.ndarray]) -> None:
    found = benchmark(lambda: ransac_pose(*points, CAMERA, threshold_px=5, seed=0))
    assert found.inliers.sum() > 120


def test_estimate_pose_200_points(benchmark: Any, points: tuple[np.ndarray, np.ndarray]) -> None:
    scanner, uv = points
    ranges = np.linalg.norm(scanner, axis=1)
    stated = {"sigma_px": 1.0, "sigma_range_m": 0.015}
    result = benchmark(lambda: lr.estimate_pose(scanner / ranges[:, None], ranges, uv, CAMERA, **stated))
    assert result.accepted


def test_texture(benchmark: Any, sample: tuple[lr.Scan, lr.Photo]) -> None:
    scan, photo = sample
    assert (benchmark(lambda: texture_scan(scan, photo, POSE)).labels == 1).any()


def test_register(benchmark: Any, sample: tuple[lr.Scan, lr.Photo]) -> None:
    result = benchmark.pedantic(lambda: lr.register(*sample), rounds=3, warmup_rounds=1)
    assert result.accepted
