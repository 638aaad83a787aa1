"""RANSAC for an initial pose from the rays of a camera of any model, such as those of a panorama.

The backends of `ransac` work in the plane of a perspective image. Here samples of three rays within one hemisphere are
turned to the front, solved in that plane, and scored by the angles of all rays.

Source: Gao et al., Complete solution classification for the perspective-three-point problem (PAMI 2003), in OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec

_MIN_POINTS = 4
_CONFIDENCE = 0.999
_MIN_COSINE = 0.2  # of the rays of a sample and their mean
_MIN_ITERATIONS = 60


def sample_pose_of_rays(
    points_scanner: FloatArray, rays_camera: FloatArray, *, threshold_rad: float, iterations: int, seed: int
) -> Rigid | None:
    """Return the pose with the lowest truncated sum of squared angles, not refined; None without four inliers.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        rays_camera: (N, 3), unit; non-finite rows are ignored.
        threshold_rad: largest angle of an inlier, rad.
        iterations: maximum number of samples.
        seed: random seed; equal seeds give equal results.
    """
    usable = np.isfinite(points_scanner).all(axis=1) & np.isfinite(rays_camera).all(axis=1)
    points, rays = points_scanner[usable], rays_camera[usable]
    if len(points) < _MIN_POINTS:
        return None
    rng = np.random.default_rng(seed)
    best: Rigid | None = None
    limit, lowest, most, needed, done = threshold_rad**2, np.inf, 0, iterations, 0
    while done < min(needed, iterations):
        done += 1
        for pose in _solutions(points, rays, rng.choice(len(points), 3, replace=False)):
            seen = pose @ points
            length = np.linalg.norm(seen, axis=1)
            squared = np.sum((seen / np.maximum(length, 1e-12)[:, None] - rays) ** 2, axis=1)
            score = float(np.minimum(squared, limit).sum())
            if score >= lowest:
                continue
            best, lowest, most = pose, score, int(np.count_nonzero(squared < limit))
            failing = 1 - (most / len(points)) ** 3
            needed = max(_MIN_ITERATIONS, int(np.log(1 - _CONFIDENCE) / np.log(min(max(failing, 1e-9), 1 - 1e-9))) + 1)
    return best if most >= _MIN_POINTS else None


def _solutions(points: FloatArray, rays: FloatArray, sample: IntArray) -> list[Rigid]:
    """Return the poses on which three points agree; none if their rays do not lie within one hemisphere."""
    mean = rays[sample].sum(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-6 or (rays[sample] @ mean).min() < _MIN_COSINE * length:
        return []
    turn = front_rotations((mean / length)[None])[0]
    ahead = rays[sample] @ turn.T
    local = points[sample] - points[sample].mean(axis=0)
    reach = float(np.abs(local).max())
    if not 0 < reach < np.inf:
        return []
    plane = np.ascontiguousarray(ahead[:, :2] / ahead[:, 2:])
    _, turns, shifts = cv2.solveP3P(local / reach, plane, np.eye(3), None, cv2.SOLVEPNP_P3P)
    found = []
    for rotvec, shift in zip(turns, shifts, strict=True):
        R, t = rotation_from_rotvec(np.ravel(rotvec)), np.ravel(shift) * reach
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            continue
        try:
            found.append(Rigid(turn.T @ R, turn.T @ (t - R @ points[sample].mean(axis=0))))
        except DegenerateGeometryError:
            continue
    return found


def front_rotations(rays: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) that turn unit rays (N, 3) to the Z axis; NaN for rays that are NaN."""
    aside = np.where(np.abs(rays[:, :1]) < 0.8, np.eye(3)[0], np.eye(3)[1])
    x = aside - rays * (rays * aside).sum(axis=1, keepdims=True)
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(rays, x), rays], axis=1)
