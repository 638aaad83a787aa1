"""Covariance of a pose: guarded inverses, and the sandwich covariance of a simplex.

Directions that the matches do not determine get a variance that is huge but finite.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.epipolar import epipolar_residuals
from ladarreg_core.thesis.estimators.stereo import StereoPairs
from ladarreg_core.thesis.estimators.stereo_simplex import Residual

_STEP, _STEP_PX, _STEP_OF_RANGE = 1e-6, 1e-2, 1e-5
_UNDETERMINED = 1e-12
_HUGE_RAD2 = np.pi**2
MIN_EIGENVALUE = 1e-13
"""Lower bound of the eigenvalues of an information matrix scaled to a unit diagonal."""


def guarded_inverse(information: FloatArray, *, least: float = MIN_EIGENVALUE) -> FloatArray:
    """Return the inverse of an information matrix (P, P) of unit diagonal, with its eigenvalues bounded from below."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors / np.maximum(values, least)) @ vectors.T)


def pose_covariance(information: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a pose from its information; huge but finite if undetermined."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = guarded_inverse(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((inverse + inverse.T) / 2)


def simplex_covariance(
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: CameraModel,
    *,
    residual: Residual,
    sigma_px: float,
    sigma_range_m: float,
) -> FloatArray:
    """Return the covariance (6, 6) of a pose from a simplex, whose residuals are not weighted by their noise.

        H^-1 (J^T W K S K^T W J) H^-1,    H = J^T W J

    with J the derivative of the residuals by the pose, K that by the measurements, and S the covariance of the
    measurements. The result is of (w, c) as in `PoseResult.covariance`; huge but finite if undetermined.

    Args:
        pose: camera_from_scanner, at the minimum.
        matches: M matches.
        inliers: (M,) matches that were used.
        camera: the photo's camera.
        residual: the residual that was minimised.
        sigma_px: pixel noise of a match of weight 1, px.
        sigma_range_m: range noise of a match of weight 1, m.

    Source: Huber, The behavior of maximum likelihood estimates under nonstandard conditions (1967).
    """
    used = matches.subset(inliers)
    reach = float(np.median(matches.ranges)) if len(matches) else 1.0
    huge = np.diag([_HUGE_RAD2] * 3 + [_HUGE_RAD2 * reach**2] * 3)
    if len(used) < 3:
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

    J = np.stack([slope(errors(shifted(d), used), errors(shifted(-d), used), _STEP) for d in _STEP * np.eye(6)])
    by_pixel = [
        slope(
            errors(pose, replace(used, uv=used.uv + way)),
            errors(pose, replace(used, uv=used.uv - way)),
            _STEP_PX,
        )
        for way in _STEP_PX * np.eye(2)
    ]
    step_m = _STEP_OF_RANGE * used.ranges
    by_range = slope(
        errors(pose, replace(used, ranges=used.ranges + step_m)),
        errors(pose, replace(used, ranges=used.ranges - step_m)),
        step_m,
    )
    spread = np.stack([*(k * sigma_px for k in by_pixel), by_range * sigma_range_m])  # (3, 2, N)
    known = np.isfinite(J).all(axis=(0, 1)) & np.isfinite(spread).all(axis=(0, 1))
    if np.count_nonzero(known) < 3:
        return huge
    J, spread, w = J[..., known], spread[..., known], used.weights[known]
    H = np.einsum("aen,ben,n->ab", J, J, w)
    scaled = np.einsum("aen,ken,n->akn", J, spread, np.sqrt(w))  # sigma^2 / weight, times weight^2
    values, vectors = np.linalg.eigh(H)
    determined = values > _UNDETERMINED * max(values[-1], 1e-300)
    inverse = vectors[:, determined] / values[determined] @ vectors[:, determined].T
    half = np.einsum("ab,bkn->akn", inverse, scaled)
    covariance = np.einsum("akn,bkn->ab", half, half) + _HUGE_RAD2 * vectors[:, ~determined] @ vectors[:, ~determined].T
    unit = np.array([1.0] * 3 + [reach] * 3)
    covariance = covariance * np.outer(unit, unit)
    return np.asarray((covariance + covariance.T) / 2) if np.isfinite(covariance).all() else huge
