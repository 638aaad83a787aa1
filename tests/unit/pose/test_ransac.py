"""RANSAC by both backends."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.pose.estimators.ransac import ransac_pose
from testing.scenes.room import room_case

BACKENDS = ("poselib", "opencv")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [4, 5, 7, 200])
def test_it_finds_the_pose_and_is_repeatable(backend, count):
    for seed in range(5):
        case = room_case(seed, count=count, outliers=0.5 if count == 200 else 0.0, sigma_px=0.1, sigma_range_m=0.001)
        found, again = (
            ransac_pose(case.matches.points, case.uv, case.camera, threshold_px=5, seed=seed, backend=backend)
            for _ in range(2)
        )
        assert found is not None
        assert found.camera_from_scanner.distance_to(case.pose) < (0.15 if count < 7 else 0.05)
        assert (found.camera_from_scanner.matrix == again.camera_from_scanner.matrix).all()
        error = np.linalg.norm(case.camera.project(found.camera_from_scanner @ case.matches.points) - case.uv, axis=1)
        assert (found.inliers == (error <= 5)).all()
        assert found.score == pytest.approx(np.minimum(np.nan_to_num(error, nan=9e9) ** 2, 25).sum())


def test_both_backends_reach_the_same_score():
    for seed in range(8):
        case = room_case(seed, outliers=0.3)
        a, b = (ransac_pose(case.matches.points, case.uv, case.camera, threshold_px=5, backend=k) for k in BACKENDS)
        assert a is not None
        assert b is not None
        assert a.score == pytest.approx(b.score, rel=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_large_coordinates_and_distortion(backend):
    lens = Camera(768, 512, 700.0, 700.0, 383.5, 255.5, (-0.25, 0.08, 0.0, 0.0))
    case = room_case(0, camera=lens, outliers=0.3)
    grid = np.array([4e5, 5.6e6, 300.0])
    found = ransac_pose(case.matches.points + grid, case.uv, lens, threshold_px=5, backend=backend)
    assert found is not None
    assert np.linalg.norm(found.camera_from_scanner.centre - grid - case.pose.centre) < 0.05


@pytest.mark.parametrize("backend", BACKENDS)
def test_points_without_a_pose_give_none_or_few_inliers(backend):
    case = room_case(0, count=30)
    behind = -case.matches.points  # same lines of sight, opposite side
    assert ransac_pose(np.zeros((10, 3)), np.zeros((10, 2)), case.camera, threshold_px=5, backend=backend) is None
    assert ransac_pose(case.matches.points[:3], case.uv[:3], case.camera, threshold_px=5, backend=backend) is None
    assert ransac_pose(np.zeros((0, 3)), np.zeros((0, 2)), case.camera, threshold_px=5, backend=backend) is None
    nothing = np.full((10, 3), np.nan)
    assert ransac_pose(nothing, case.uv[:10], case.camera, threshold_px=5, backend=backend) is None
    found = ransac_pose(behind, case.uv, case.camera, threshold_px=2, backend=backend)
    if found is not None:
        assert ((found.camera_from_scanner @ behind)[found.inliers, 2] > 0).all()
    rng = np.random.default_rng(0)
    noise = ransac_pose(case.matches.points, rng.uniform(0, 500, (30, 2)), case.camera, threshold_px=3, backend=backend)
    assert noise is None or noise.inliers.sum() < 12


def test_invalid_options_are_refused():
    case = room_case(0, count=10)
    for bad in ({"threshold_px": 0.0}, {"threshold_px": np.nan}, {"iterations": 0}, {"seed": -1}, {"backend": "x"}):
        with pytest.raises(OptionError):
            ransac_pose(case.matches.points, case.uv, case.camera, **{"threshold_px": 5.0, **bad})
    with pytest.raises(ShapeError):
        ransac_pose(case.matches.points, case.uv[:5], case.camera, threshold_px=5)
