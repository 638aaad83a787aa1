"""How uncertain a least-squares pose is whose residuals are not weighted by their noise.

    H^-1 (J^T W K S K^T W J) H^-1,    H = J^T W J

with J the residuals' derivative by the pose, K that by the measurements, and S the measurements' covariance. Source:
Huber, The behavior of maximum likelihood estimates under nonstandard conditions (1967).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.thesis.epipolar import epipolar_residuals
from ladarreg_core.pose.thesis.stereo import StereoPairs
from ladarreg_core.pose.thesis.stereo_simplex import Residual

_STEP, _STEP_PX, _STEP_OF_RANGE = 1e-6, 1e-2, 1e-5
_UNDETERMINED = 1e-12
_HUGE_RAD2 = np.pi**2


def simplex_covariance(
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: Camera,
    *,
    residual: Residual,
    sigma_px: float,
    sigma_range_m: float,
) -> FloatArray:
    """Return the covariance (6, 6) of (w, c) as `PoseResult.covariance`; huge but finite where nothing determines it.

    Args:
        pose: camera_from_scanner, at the least cost.
        matches: M matches.
        inliers: (M,) those that counted.
        camera: the photo's camera.
        residual: what was minimised.
        sigma_px: pixel noise of a match of weight 1, px.
        sigma_range_m: range noise likewise, m.
    """
    counted = matches.subset(inliers)
    reach = float(np.median(matches.ranges)) if len(matches) else 1.0
    huge = np.diag([_HUGE_RAD2] * 3 + [_HUGE_RAD2 * reach**2] * 3)
    if len(counted) < 3:
        return huge
    frame = StereoPairs.of(matches, camera).frame_from_scanner

    def errors(of_pose: Rigid, of_matches: Matches) -> FloatArray:
        """Return the residuals, (2, N)."""
        pairs = StereoPairs.of(of_matches, camera, frame_from_scanner=frame)
        x = pairs.parameters(of_pose)
        with np.errstate(all="ignore"):
            return epipolar_residuals(x, pairs) if residual == "epipolar" else pairs.depth - pairs.depths(x)

    def shifted(step: FloatArray) -> Rigid:
        return Rigid.from_centre(rotation_from_rotvec(step[:3]) @ pose.rotation, pose.centre + step[3:] * reach)

    def slope(forward: FloatArray, back: FloatArray, step: float | FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray((forward - back) / (2 * step))

    J = np.stack([slope(errors(shifted(d), counted), errors(shifted(-d), counted), _STEP) for d in _STEP * np.eye(6)])
    by_pixel = [
        slope(
            errors(pose, replace(counted, uv=counted.uv + way)),
            errors(pose, replace(counted, uv=counted.uv - way)),
            _STEP_PX,
        )
        for way in _STEP_PX * np.eye(2)
    ]
    step_m = _STEP_OF_RANGE * counted.ranges
    by_range = slope(
        errors(pose, replace(counted, ranges=counted.ranges + step_m)),
        errors(pose, replace(counted, ranges=counted.ranges - step_m)),
        step_m,
    )
    spread = np.stack([*(k * sigma_px for k in by_pixel), by_range * sigma_range_m])  # (3, 2, N)
    assert counted.weights is not None
    known = np.isfinite(J).all(axis=(0, 1)) & np.isfinite(spread).all(axis=(0, 1))
    if np.count_nonzero(known) < 3:
        return huge
    J, spread, w = J[..., known], spread[..., known], counted.weights[known]
    H = np.einsum("aen,ben,n->ab", J, J, w)
    pushed = np.einsum("aen,ken,n->akn", J, spread, np.sqrt(w))  # sigma^2 / weight, times the weight twice
    values, vectors = np.linalg.eigh(H)
    determined = values > _UNDETERMINED * max(values[-1], 1e-300)
    inverse = vectors[:, determined] / values[determined] @ vectors[:, determined].T
    half = np.einsum("ab,bkn->akn", inverse, pushed)
    covariance = np.einsum("akn,bkn->ab", half, half) + _HUGE_RAD2 * vectors[:, ~determined] @ vectors[:, ~determined].T
    unit = np.array([1.0] * 3 + [reach] * 3)
    covariance = covariance * np.outer(unit, unit)
    return np.asarray((covariance + covariance.T) / 2) if np.isfinite(covariance).all() else huge
