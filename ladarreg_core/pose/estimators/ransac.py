"""RANSAC for an initial pose: three-point samples, scored by the truncated squared error.

Source: P3P inside a locally optimised RANSAC, by poselib if installed, otherwise by OpenCV's USAC. The pose of either
backend is refined in the same way, so that the result does not depend on the backend.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.errors import DegenerateGeometryError, DependencyError, OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.frames import Rigid, rotation_from_rotvec

Backend = Literal["auto", "poselib", "opencv"]

_log = logging.getLogger(__name__)
_MIN_POINTS = 4  # three give up to four solutions; the fourth selects one
_MIN_ITERATIONS = 30
_CONFIDENCE = 0.999
_POLISH_STEPS = 10
_MAX_PIXELS = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class RansacResult:
    """A pose with its inliers."""

    camera_from_scanner: Rigid
    """The pose, refined on its inliers."""
    inliers: BoolArray
    """(N,) bool: in front of the camera and within the threshold."""
    score: float
    """Sum over all points of min(error^2, threshold^2), px^2; lower is better."""


def ransac_pose(
    points_scanner: ArrayLike,
    uv: ArrayLike,
    camera: Camera,
    *,
    threshold_px: float,
    iterations: int = 5000,
    seed: int = 0,
    backend: Backend = "auto",
) -> RansacResult | None:
    """Find the pose with the most inliers; equal inputs and seeds give equal results.

    Args:
        points_scanner: (N, 3), scanner frame, m; non-finite points are outliers.
        uv: (N, 2), photo pixels; non-finite pixels are outliers.
        camera: the photo's camera; errors are measured in the undistorted image.
        threshold_px: largest error of an inlier, px.
        iterations: maximum number of samples; the search stops earlier if a better pose is unlikely.
        seed: random seed.
        backend: `auto` uses poselib if it is installed.

    Returns:
        The best pose, or None if no pose has four inliers.

    Raises:
        ShapeError: if the shapes disagree.
        OptionError: if the threshold, the iterations or the seed is invalid.
        DependencyError: if the requested backend is not installed.
    """
    points = read_only(points_scanner, np.float64, (None, 3), "the scan points")
    pixels = read_only(uv, np.float64, (len(points), 2), "the photo pixels")
    if not (np.isfinite(threshold_px) and threshold_px > 0):
        raise OptionError(f"the RANSAC threshold is {threshold_px}; it must be a positive number of pixels")
    if iterations < 1 or seed < 0:
        raise OptionError(
            f"RANSAC got {iterations} iterations and the seed {seed}; it needs at least 1 iteration and a seed of at "
            "least 0"
        )
    ideal = camera.without_distortion()
    if camera.distortion:
        pixels = ideal.project(camera.unproject(pixels))
    pose = sample_pose(
        points, pixels, ideal, threshold_px=threshold_px, iterations=iterations, seed=seed, backend=backend
    )
    if pose is None:
        return None
    squared = _squared_errors(pose, points, pixels, ideal)
    usable = np.isfinite(squared)
    if np.count_nonzero(usable) >= _MIN_POINTS:
        pose = _polish(pose, points[usable], pixels[usable], ideal, threshold_px)
        squared = _squared_errors(pose, points, pixels, ideal)
    inliers = squared <= threshold_px**2
    if np.count_nonzero(inliers) < _MIN_POINTS:
        return None
    return RansacResult(pose, inliers, float(np.minimum(squared, threshold_px**2).sum()))


def sample_pose(
    points_scanner: FloatArray,
    uv_ideal: FloatArray,
    camera: Camera,
    *,
    threshold_px: float,
    iterations: int,
    seed: int,
    backend: Backend = "auto",
) -> Rigid | None:
    """Return the pose from the backend without refinement, or None; for callers that refine it themselves.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        uv_ideal: (N, 2), pixels of the undistorted image; non-finite rows are ignored.
        camera: intrinsics without distortion.
        threshold_px: largest error of an inlier, px.
        iterations: maximum number of samples.
        seed: random seed.
        backend: `auto` uses poselib if it is installed.
    """
    search = _search(backend)
    usable = np.isfinite(points_scanner).all(axis=1) & np.isfinite(uv_ideal).all(axis=1)
    if np.count_nonzero(usable) < _MIN_POINTS:
        return None
    points, uv = points_scanner[usable], np.ascontiguousarray(uv_ideal[usable])
    # centre and scale the points: with large coordinates both backends lose precision
    middle = len(points) // 2
    ordered = np.partition(points, (middle - 1, middle), axis=0)
    origin = ordered[middle] if len(points) % 2 else (ordered[middle - 1] + ordered[middle]) / 2  # the median
    local = points - origin
    reach = float(np.abs(local).max())
    if not (0 < reach < np.inf) or float(np.abs(uv).max()) > _MAX_PIXELS:
        return None
    found = search(local / reach, uv, camera, float(threshold_px), int(iterations), int(seed))
    if found is None:
        return None
    return Rigid(found[0], found[1] * reach - found[0] @ origin)


_Search = Callable[[FloatArray, FloatArray, Camera, float, int, int], "tuple[FloatArray, FloatArray] | None"]


@cache
def _has_poselib() -> bool:
    return importlib.util.find_spec("poselib") is not None


def _search(backend: Backend) -> _Search:
    if backend not in ("auto", "poselib", "opencv"):
        raise OptionError(f"the RANSAC backend is {backend!r}; it must be 'auto', 'poselib' or 'opencv'")
    if backend == "poselib" and not _has_poselib():
        raise DependencyError("poselib is not installed; install ladarreg[fast] or use the backend 'opencv'")
    return _by_poselib if backend != "opencv" and _has_poselib() else _by_usac


def _by_poselib(
    points: FloatArray, uv: FloatArray, camera: Camera, threshold_px: float, iterations: int, seed: int
) -> tuple[FloatArray, FloatArray] | None:
    import poselib

    lens = {"model": "PINHOLE", "width": camera.width, "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy]}  # fmt: skip
    options = {
        "max_reproj_error": threshold_px,
        "max_iterations": iterations,
        "min_iterations": min(iterations, _MIN_ITERATIONS),
        "success_prob": _CONFIDENCE,
        "seed": seed,
    }
    pose, report = poselib.estimate_absolute_pose(uv, points, lens, options)
    return _checked(pose.R, pose.t) if report["num_inliers"] >= 3 else None


def _by_usac(
    points: FloatArray, uv: FloatArray, camera: Camera, threshold_px: float, iterations: int, seed: int
) -> tuple[FloatArray, FloatArray] | None:
    options: Any = cv2.UsacParams()
    options.threshold = threshold_px
    options.maxIterations = iterations
    options.confidence = _CONFIDENCE
    options.score = cv2.SCORE_METHOD_MSAC
    options.sampler = cv2.SAMPLING_UNIFORM
    options.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    options.isParallel = False
    options.randomGeneratorState = seed % 2**31
    try:
        found, _, turn, shift, _ = cv2.solvePnPRansac(points, uv, camera.matrix, None, params=options)
    except cv2.error as error:  # raised for samples without a solution
        _log.debug("USAC failed: %s", str(error).replace("\n", " "))
        return None
    return _checked(rotation_from_rotvec(turn.ravel()), shift.ravel().astype(np.float64)) if found else None


def _checked(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    R, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    try:
        return Rigid(R, t).rotation, t
    except DegenerateGeometryError:
        return None


def _squared_errors(pose: Rigid, points: FloatArray, uv: FloatArray, camera: Camera) -> FloatArray:
    with np.errstate(invalid="ignore", over="ignore"):
        squared = np.sum((camera.project(pose @ points) - uv) ** 2, axis=-1)
    return np.where(np.isfinite(squared), squared, np.inf)


def _polish(pose: Rigid, points: FloatArray, uv: FloatArray, camera: Camera, threshold_px: float) -> Rigid:
    """Refine a pose by Gauss-Newton on its inliers while the truncated squared error decreases."""
    limit = threshold_px**2
    squared = _squared_errors(pose, points, uv, camera)
    score = np.minimum(squared, limit).sum()
    for _ in range(_POLISH_STEPS):
        inliers = squared <= limit
        if np.count_nonzero(inliers) < _MIN_POINTS:
            break
        predicted, J = pose_jacobian(pose, points[inliers], camera)
        J = J.reshape(-1, 6)
        step = np.linalg.lstsq(J, (uv[inliers] - predicted).ravel(), rcond=1e-12)[0]
        if not np.isfinite(step).all():
            break
        moved = Rigid.from_centre(rotation_from_rotvec(step[:3]) @ pose.rotation, pose.centre + step[3:])
        squared = _squared_errors(moved, points, uv, camera)
        lower = np.minimum(squared, limit).sum()
        if not lower < score:
            break
        settled = lower > score * (1 - 1e-9)
        pose, score = moved, lower
        if settled:
            break
    return pose
