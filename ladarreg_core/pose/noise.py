"""Estimation of pixel noise and range noise from the scatter of the inliers.

A range error moves the pixel only along the epipolar line. Scatter across that line is therefore pixel noise alone, and
the excess along it is range noise:

    variance across = sigma_u^2,    variance along = sigma_u^2 + sigma_r^2 |d pi / d rho|^2

If the baseline is too short to show the range noise, the range noise does not matter either, and a broad prior keeps
the stated value. Source: maximum likelihood of the two variance components.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import CameraModel
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, across_lines

_PARAMETERS = 6
_LEAST_PX = 0.05
_PRIOR_LOG_SIGMA = np.log(3.0)
_STEPS = 41
_ROUNDS = 6


def estimate_noise(
    pose: Rigid,
    inliers: Matches,
    camera: CameraModel,
    *,
    stated_range_m: float,
    most_px: float,
    most_range_m: float,
    fixed_px: float | None = None,
    fixed_range_m: float | None = None,
) -> tuple[float, float]:
    """Return (sigma_px, sigma_range_m) of a match of weight 1.

    Args:
        pose: camera_from_scanner, fitted to the inliers.
        inliers: the inliers, all in front of the camera.
        camera: intrinsics.
        stated_range_m: centre of the prior, m.
        most_px: upper bound of the pixel noise, px.
        most_range_m: upper bound of the range noise, m.
        fixed_px: pixel noise if known, px.
        fixed_range_m: range noise if known, m.
    """
    points = pose @ inliers.points
    uv, d_uv = camera.project_with_jacobian(points)
    e: FloatArray = camera.difference(inliers.uv, uv) * np.sqrt(inliers.weights)[:, None]
    j: FloatArray = (d_uv @ (inliers.rays @ pose.rotation.T)[..., None])[..., 0] / np.sqrt(inliers.range_weights)[
        :, None
    ]
    e, j = across_lines(inliers, e), across_lines(inliers, j)
    length2 = (j * j).sum(axis=1)
    along2 = np.divide((e * j).sum(axis=1) ** 2, length2, out=np.zeros(len(e)), where=length2 > 0)
    across2 = np.maximum((e * e).sum(axis=1) - along2, 0)
    dof = int(inliers.dimensions.sum())
    free = dof - len(e)  # coordinates unaffected by range errors
    fitted = dof / max(dof - _PARAMETERS, 1)  # the fitted pose absorbs part of the scatter
    along2, across2 = along2 * fitted, across2 * fitted

    least_range_m = min(stated_range_m, most_range_m) / 30
    grid = (
        np.geomspace(least_range_m, most_range_m, _STEPS) if fixed_range_m is None else np.array([float(fixed_range_m)])
    )
    by_range = grid[:, None] ** 2 * length2
    variance = np.full(len(grid), float(fixed_px) ** 2 if fixed_px is not None else 1.0)
    if fixed_px is None:
        variance = _pixel_variance(along2, across2, by_range, dof=dof)
        variance = np.clip(variance, _LEAST_PX**2, most_px**2)
    total = variance[:, None] + by_range
    cost = (np.log(total) + along2 / total).sum(axis=1) + free * np.log(variance) + across2.sum() / variance
    cost += (np.log(grid / stated_range_m) / _PRIOR_LOG_SIGMA) ** 2
    best = int(np.argmin(cost))
    return float(np.sqrt(variance[best])), float(grid[best])


def _pixel_variance(along2: FloatArray, across2: FloatArray, by_range: FloatArray, *, dof: int) -> FloatArray:
    """Return the maximum-likelihood pixel variance for each range noise, by fixed-point iteration."""
    variance = np.full(len(by_range), max((across2.sum() + along2.sum()) / dof, _LEAST_PX**2))
    for _ in range(_ROUNDS):
        # expected contribution of pixel noise to the scatter along the line, given the current variances
        share = variance[:, None] / (variance[:, None] + by_range)
        part = share * share * along2 + share * by_range
        variance = np.maximum((across2.sum() + part.sum(axis=1)) / dof, _LEAST_PX**2)
    return variance
