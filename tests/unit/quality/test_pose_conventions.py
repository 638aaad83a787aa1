"""Poses in other conventions are recognised by what the camera would see."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ladarreg_core as lr
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.quality.pose_conventions import other_convention
from testing.scenes.simulated import simulated

OPENGL = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
BODY = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))


def swapped(pose: Rigid) -> Rigid:
    """The pose of somebody who read x y z w where w x y z was written."""
    return Rigid(Rotation.from_quat(pose.quaternion_wxyz).as_matrix(), pose.translation)


WRITTEN = {
    "scanner_from_camera": lambda pose: pose.inverse,
    "OpenGL": lambda pose: OPENGL @ pose,
    "the inverse, with OpenGL": lambda pose: (OPENGL @ pose).inverse,
    "robot": lambda pose: BODY.inverse @ pose,
    "the inverse, with a robot": lambda pose: (BODY.inverse @ pose).inverse,
    "quaternion": swapped,
}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("convention", WRITTEN)
def test_the_convention_of_a_pose_is_named(convention: str, seed: int) -> None:
    case = simulated("office" if seed == 1 else "boxes", seed=seed)
    pose = case.camera_from_scanner
    assert other_convention(case.scan, case.photo.camera, pose) is None
    said = other_convention(case.scan, case.photo.camera, WRITTEN[convention](pose))
    assert said is not None
    assert convention in said
    assert "camera_from_scanner" in said


def test_rough_poses_and_slanted_cameras_are_not_doubted() -> None:
    case = simulated("boxes", seed=3)
    for degrees in (-40, 40):
        rolled = Rigid.from_rotvec([0, 0, np.radians(degrees)], (0, 0, 0)) @ case.camera_from_scanner
        assert other_convention(case.scan, case.photo.camera, rolled) is None


def test_a_pose_that_no_convention_explains_is_left_alone() -> None:
    case = simulated("boxes", seed=3)
    away = Rigid(case.camera_from_scanner.rotation, np.array([0.0, 0.0, -500.0]))
    assert other_convention(case.scan, case.photo.camera, away) is None


def test_results_say_so() -> None:
    case = simulated("boxes", seed=3)
    turned = OPENGL @ case.camera_from_scanner
    given = lr.given_pose(case.scan, case.photo, turned, check_images=False)
    assert any("OpenGL" in reason for reason in given.reasons)
    right = lr.given_pose(case.scan, case.photo, case.camera_from_scanner, check_images=False)
    assert not any("convention" in reason or "OpenGL" in reason for reason in right.reasons)
    other = simulated("office", seed=1).photo
    refused = lr.register(case.scan, other, initial=turned)
    assert not refused.accepted
    assert any("OpenGL" in reason for reason in refused.reasons)
