"""The thesis's linear method: exact without noise, refused for degenerate matches."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.estimate import estimate_pose
from ladarreg_core.thesis.estimators.linear import linear_pose
from testing.scenes.pose_case import difference
from testing.scenes.room import room_case


def test_it_is_exact_on_exact_matches():
    for seed in range(10):
        pose = room_case(seed, count=1).pose
        rng = np.random.default_rng(seed)
        points = pose.inverse @ rng.uniform([-1, -1, 2.5], [1, 1, 5], (7 + 3 * seed, 3))
        seen = pose @ points
        found = linear_pose(points, seen[:, :2] / seen[:, 2:])
        assert np.abs(difference(pose, found)).max() < 1e-7


def test_its_translation_is_that_of_the_corrected_back_substitution():
    # R = 1 and T = (-.4, .2, .643): with the sign of the thesis's text Tz would come out elsewhere.
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, 3], [2, 2, 7], (20, 3))
    pose = Rigid(np.eye(3), np.array([-0.4, 0.2, 0.643]))
    seen = pose @ points
    assert linear_pose(points, seen[:, :2] / seen[:, 2:]).translation == pytest.approx([-0.4, 0.2, 0.643], abs=1e-9)


def test_its_covariance_is_consistent():
    distances, kept = [], 0
    for seed in range(30):
        case = room_case(seed, count=100)
        result = estimate_pose(
            case.rays, case.ranges, case.uv, case.camera, method="linear", sigma_px=1.0, sigma_range_m=0.015
        )
        step = difference(case.pose, result.camera_from_scanner)
        distances.append(step @ np.linalg.solve(result.covariance, step) / 6)
        kept += result.camera_from_scanner.distance_to(case.pose) < 0.3
    assert kept == 30
    assert 0.7 < np.sqrt(np.mean(distances)) < 1.4


def test_it_refuses_a_plane_and_too_few():
    rng = np.random.default_rng(1)
    points = np.column_stack([np.full(40, 4.0) + rng.normal(size=40) * 0.1, rng.uniform(-1.5, 1.5, (40, 2))])
    with pytest.raises(DegenerateGeometryError, match="too close to a plane"):
        linear_pose(points, rng.uniform(-0.4, 0.4, (40, 2)))
    case = room_case(0, count=6)
    with pytest.raises(DegenerateGeometryError, match="needs 7"):
        estimate_pose(case.rays, case.ranges, case.uv, case.camera, method="linear")
