"""Pose solvers for matches with outliers: variants of the default, and the usual libraries."""

from __future__ import annotations

import importlib.util

import cv2
import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.ransac import ransac_pose
from testing.scenes.accuracy import Answer, Solver, default, known_inliers
from testing.scenes.pose_case import Case

MAX_ITERATIONS = 5000
THRESHOLD_SIGMA = 6.0


def default_unstated(case: Case) -> Answer | None:
    try:
        result = solve_pose(case.matches, case.camera, PoseOptions())
    except LadarregError:
        return None
    return result.camera_from_scanner, result.covariance


def default_without_poselib(case: Case) -> Answer | None:
    return default(case, ransac_backend="opencv")


def linear(case: Case) -> Answer | None:
    return default(case, method="linear")


def ransac_alone(case: Case) -> Answer | None:
    found = ransac_pose(case.matches.points, case.uv, case.camera, threshold_px=THRESHOLD_SIGMA * case.sigma_px)
    return (found.camera_from_scanner, None) if found else None


def poselib_peer(case: Case) -> Answer | None:
    import poselib

    c = case.camera
    lens = {"model": "PINHOLE", "width": c.width, "height": c.height, "params": [c.fx, c.fy, c.cx, c.cy]}
    how = {"max_reproj_error": THRESHOLD_SIGMA * case.sigma_px, "max_iterations": MAX_ITERATIONS}
    pose, _ = poselib.estimate_absolute_pose(case.uv, case.matches.points, lens, how)
    return Rigid(pose.R, pose.t), None


def opencv_peer(case: Case) -> Answer | None:
    cv2.setRNGSeed(0)
    points, K = np.array(case.matches.points), case.camera.matrix
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, case.uv, K, None, iterationsCount=MAX_ITERATIONS,
        reprojectionError=THRESHOLD_SIGMA * case.sigma_px, confidence=0.9999,
    )  # fmt: skip
    if not found:
        return None
    keep = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[keep], case.uv[keep], K, None, turn, shift)
    return Rigid(cv2.Rodrigues(turn)[0], shift.ravel()), None


def sqpnp_known_inliers(case: Case) -> Answer | None:
    return _opencv_known_inliers(case, cv2.SOLVEPNP_SQPNP)


def epnp_known_inliers(case: Case) -> Answer | None:
    return _opencv_known_inliers(case, cv2.SOLVEPNP_EPNP)


def _opencv_known_inliers(case: Case, flags: int) -> Answer | None:
    points = np.array(case.matches.points[case.true])
    found, turn, shift = cv2.solvePnP(points, case.uv[case.true], case.camera.matrix, None, flags=flags)
    return (Rigid(cv2.Rodrigues(turn)[0], shift.ravel()), None) if found else None


def opencv_from_a_start(case: Case, start: Rigid) -> Answer | None:
    """Refine a start by OpenCV's Levenberg-Marquardt on all matches."""
    turn, shift = cv2.Rodrigues(start.rotation)[0], start.translation.reshape(3, 1).copy()
    try:
        found, turn, shift = cv2.solvePnP(
            np.array(case.matches.points), case.uv, case.camera.matrix, None, turn, shift,
            useExtrinsicGuess=True, flags=cv2.SOLVEPNP_ITERATIVE,
        )  # fmt: skip
    except cv2.error:
        return None
    return (Rigid(cv2.Rodrigues(turn)[0], shift.ravel()), None) if found else None


_ALL: dict[str, Solver] = {
    "default": default,
    "default, noise not stated": default_unstated,
    "default, OpenCV's RANSAC": default_without_poselib,
    "default, true inliers known": known_inliers,
    "our RANSAC alone": ransac_alone,
    "poselib RANSAC + bundle": poselib_peer,
    "OpenCV RANSAC + refineLM": opencv_peer,
    "OpenCV SQPnP, true inliers known": sqpnp_known_inliers,
    "OpenCV EPnP, true inliers known": epnp_known_inliers,
}
HAS_POSELIB = importlib.util.find_spec("poselib") is not None
PEERS: dict[str, Solver] = {name: peer for name, peer in _ALL.items() if HAS_POSELIB or peer is not poselib_peer}
"""Solvers by name; poselib only where it is installed."""
