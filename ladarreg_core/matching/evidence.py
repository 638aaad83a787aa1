"""How uncertain an aligned pose is, by the scatter of the windows that agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import FloatArray, IntArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import Agreement
from ladarreg_core.matching.points import ViewPoints
from ladarreg_core.pose.jacobian import pose_jacobian

_TRUSTED_PX = 3.0
_SD_OF_MEDIAN = 1.4826
_LEAST_SCATTER_PX = 0.02
_PRIOR_ANGLE_RAD, _PRIOR_POSITION_M = np.pi, 100.0


@dataclass(frozen=True, slots=True, eq=False)
class WindowEvidence:
    """The windows as measurements."""

    agreeing: int
    """Windows that count."""
    covariance: FloatArray
    """(6, 6) of (w, c) as `PoseResult.covariance`."""
    scatter_px: float
    """Standard deviation of the agreeing windows' displacements, photo pixels."""


def window_evidence(
    maps: Agreement, points: ViewPoints, working: Camera, camera: Camera, pose: Rigid
) -> WindowEvidence:
    """Turn the pooled maps at an accepted pose into measurements.

    Each agreeing window is one 2-D measurement, taken at its middle block. Windows pool 3 x 3 blocks, so neighbours
    repeat each other: the information is divided by how many blocks a window pools.

    Args:
        maps: agreement at the finished pose.
        points: the scan points of that level.
        working: the ideal camera of that level.
        camera: the photo's own camera.
        pose: `camera_from_scanner`.
    """
    shift, _, border = maps.peaks()
    index = np.array([_middle(points, members) for members in maps.members], dtype=np.intp)
    at = points.points[index].astype(np.float64).reshape(-1, 3)
    uv = camera.project(working.unproject(working.project(pose @ at) + shift.reshape(-1, 2)))
    to_photo = camera.focal_px / working.focal_px
    offset = np.hypot(*shift.T) * to_photo if len(shift) else np.zeros(0)
    inliers = (offset <= _TRUSTED_PX * max(1.0, to_photo)) & ~border & np.isfinite(uv).all(axis=-1)

    used = np.flatnonzero(inliers)
    prior = np.diag([_PRIOR_ANGLE_RAD**2] * 3 + [_PRIOR_POSITION_M**2] * 3)
    if len(used) < 4:
        return WindowEvidence(len(used), prior, float("nan"))
    _, J = pose_jacobian(pose, at[used], camera)
    # From the median: the pose is a robust estimate, which windows that hardly agree do not move.
    scatter = float(_SD_OF_MEDIAN * to_photo * np.median(np.abs(shift[used]))) + _LEAST_SCATTER_PX
    pooled = maps.pooled_blocks[used].astype(np.float64)
    information = np.einsum("n,nip,niq->pq", 1 / pooled, J, J) / scatter**2
    covariance = np.linalg.inv(information + np.linalg.inv(prior))
    return WindowEvidence(len(used), (covariance + covariance.T) / 2, scatter)


def _middle(points: ViewPoints, members: IntArray) -> int:
    """Return the visible point nearest to the middle of its block."""
    uv = points.uv[members]
    return int(members[np.argmin(((uv - uv.mean(axis=0)) ** 2).sum(axis=-1))])
