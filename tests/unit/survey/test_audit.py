"""The audit of a pose that is in use: its answer, and the power that it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.audit import FALSE_ALARM, SEEN, audit, judged, power_of, probability_of
from ladarreg_core.survey.least_squares.problem import moved_pose, pose_difference

COVARIANCE = np.diag([2e-4, 3e-4, 1e-4, 0.004, 0.006, 0.003]) ** 2


@pytest.fixture(scope="module")
def case() -> tuple[lr.Scan, lr.Photo, Rigid, lr.Registration]:
    made = lr.simulate_case("office", seed=2)
    return made.scan, made.photo, made.camera_from_scanner, lr.register(made.scan, made.photo)


def _found(case: tuple[lr.Scan, lr.Photo, Rigid, lr.Registration], pose: Rigid) -> lr.Registration:
    return replace(case[3], camera_from_scanner=pose, covariance=COVARIANCE, camera_uncertainty=None)


def _called_wrong(error: NDArray[np.float64], count: int) -> float:
    """Return how often a pose with an error is called wrong, where the images are off as their covariance says."""
    rng = np.random.default_rng(1)
    at = Rigid.from_rotvec([0.3, -0.8, 0.2], [0.4, 0.1, 0.7])
    used, wrong = moved_pose(at, error), 0
    for _ in range(count):
        found = moved_pose(at, rng.normal(0, 1, 6) * np.sqrt(np.diag(COVARIANCE)))
        wrong += probability_of(pose_difference(found, used), COVARIANCE) < FALSE_ALARM
    return wrong / count


def test_right_poses_are_called_wrong_as_often_as_stated() -> None:
    assert abs(_called_wrong(np.zeros(6), 1500) - FALSE_ALARM) < 0.017  # three standard deviations of the count


@pytest.mark.parametrize("error", [[0, 8e-4, 0, 0, 0, 0], [0, 0, 0, 0.008, 0, 0.009]])
def test_errors_are_seen_as_often_as_promised(error: list[float]) -> None:
    promised = power_of(COVARIANCE, np.array(error))
    assert 0.2 < promised < 0.95
    assert abs(_called_wrong(np.array(error, float), 800) - promised) < 0.055


@pytest.mark.slow
def test_the_smallest_error_is_where_the_curve_says(case: tuple[lr.Scan, lr.Photo, Rigid, lr.Registration]) -> None:
    found = judged(_found(case, case[2]), case[2])
    for curve, smallest in (
        (found.rotation_power, found.smallest_rotation_rad),
        (found.position_power, found.smallest_position_m),
    ):
        sizes, seen = np.array([[one.size, one.probability] for one in curve]).T
        assert (np.diff(seen) >= -1e-9).all()
        assert seen[0] < 0.2
        assert seen[-1] > 0.999
        assert sizes[seen < SEEN].max() < smallest < sizes[seen > SEEN].min()


@pytest.mark.slow
def test_a_registration_that_verifies_nothing_decides_nothing(
    case: tuple[lr.Scan, lr.Photo, Rigid, lr.Registration],
) -> None:
    found = judged(replace(case[3], accepted=False, reasons=("Only 3 regions agree.",)), case[2])
    assert found.outcome == "undecidable"
    assert "only 3 regions" in found.sentence
    assert found.as_fields()["correction"] is None


@pytest.mark.slow
def test_the_images_judge_a_pose(case: tuple[lr.Scan, lr.Photo, Rigid, lr.Registration]) -> None:
    scan, photo, pose, _ = case
    right = audit(scan, photo, pose)
    assert right.outcome == "right"
    wrong = audit(scan, photo, moved_pose(pose, np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0])))
    assert wrong.outcome == "wrong"
    assert wrong.corrected is not None
    assert wrong.corrected.distance_to(pose) < 0.03
    assert "correct it" in wrong.sentence


def test_a_camera_of_another_size_is_refused(case: tuple[lr.Scan, lr.Photo, Rigid, lr.Registration]) -> None:
    scan, photo, pose, _ = case
    with pytest.raises(OptionError, match="30 x 20"):
        audit(scan, photo, pose, camera=Camera.from_focal(30, 20, 25.0))
