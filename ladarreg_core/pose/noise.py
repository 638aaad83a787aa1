"""Estimation of pixel noise and range noise from the scatter of the inliers.

A range error moves the pixel only along the epipolar line. Scatter across that line is therefore pixel noise alone, and
the excess along it is range noise:

    variance across = sigma_u^2,    variance along = sigma_u^2 + sigma_r^2 |d pi / d rho|^2

If the baseline is too short to show the range noise, the range noise does not matter either, and a broad prior keeps
the stated value.

The inverse of the noise is what decides on inliers, weights and the covariance of a pose. So the estimate is the one
whose inverse square is right in the mean: of few matches, it is larger than the scatter.

Source: maximum likelihood of the two variance components; Rousseeuw and Leroy, Robust regression and outlier detection
(1987), for the consistency of a scale of inliers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, across_lines

_PARAMETERS = 6
_OF_INVERSE = 2  # E[1 / chi2_n] = 1 / (n - 2)
_MIN_PX = 0.05
_PRIOR_LOG_SIGMA = np.log(3.0)
_STEPS, _COARSE = 41, 5  # the cost has one minimum, so that every fifth value brackets it
_ROUNDS = 6
_FRACTIONS = np.linspace(0, 1, _STEPS)


def estimate_noise(
    pose: Rigid,
    matches: Matches,
    camera: CameraModel,
    *,
    members: BoolArray | None = None,
    stated_range_m: float,
    most_px: float,
    most_range_m: float,
    fixed_px: float | None = None,
    fixed_range_m: float | None = None,
    gate_chi2: float = np.inf,
) -> tuple[float, float]:
    """Return (sigma_px, sigma_range_m) of a match of weight 1.

    Args:
        pose: camera_from_scanner, fitted to the inliers.
        matches: M matches.
        camera: intrinsics.
        members: (M,) the inliers, all in front of the camera; None: all.
        stated_range_m: centre of the prior, m.
        most_px: upper bound of the pixel noise, px.
        most_range_m: upper bound of the range noise, m.
        fixed_px: pixel noise if known, px.
        fixed_range_m: range noise if known, m.
        gate_chi2: largest cost s of a member, by which larger errors are missing from their scatter.
    """
    keep: Any = slice(None) if members is None else members
    rays = matches.rays[keep]
    uv, d_uv = camera.project_with_jacobian(pose @ (rays * matches.ranges[keep, None]))
    e = across_lines(matches, camera.difference(matches.uv[keep], uv), keep) * np.sqrt(matches.weights[keep])[:, None]
    by_range = np.einsum("nij,nj->ni", d_uv, rays @ pose.rotation.T)
    j = across_lines(matches, by_range, keep) / np.sqrt(matches.range_weights[keep])[:, None]
    length2 = np.einsum("ni,ni->n", j, j)
    along2 = np.divide(np.einsum("ni,ni->n", e, j) ** 2, length2, out=np.zeros(len(e)), where=length2 > 0)
    across2 = np.maximum(np.einsum("ni,ni->n", e, e) - along2, 0)
    dimensions = matches.dimensions[keep]
    dof = int(dimensions.sum())
    free = dof - len(e)  # coordinates unaffected by range errors
    kept = _share_of_scatter(dimensions, gate_chi2)
    kept *= max(dof - _PARAMETERS - _OF_INVERSE, 1) / dof  # the fitted pose absorbs part of the scatter
    along2, across2 = along2 / kept, across2 / kept

    least_range_m = min(stated_range_m, most_range_m) / 30
    grid = (
        least_range_m * (most_range_m / least_range_m) ** _FRACTIONS
        if fixed_range_m is None
        else np.array([float(fixed_range_m)])
    )
    rest = float(across2.sum())

    def profile(of_range: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the costs of range noises (G,), each with its best pixel variance (G,)."""
        by_range = of_range[:, None] ** 2 * length2
        if fixed_px is not None:
            variance = np.full(len(of_range), float(fixed_px) ** 2)
        else:
            variance = _pixel_variance(along2, rest, by_range, dof=dof)
            variance = np.clip(variance, _MIN_PX**2, most_px**2)
        total = variance[:, None] + by_range
        cost = (np.log(total) + along2 / total).sum(axis=1) + free * np.log(variance) + rest / variance
        return cost + (np.log(of_range / stated_range_m) / _PRIOR_LOG_SIGMA) ** 2, variance

    coarse = np.arange(0, len(grid), _COARSE)
    nearest = coarse[int(np.argmin(profile(grid[coarse])[0]))]
    fine = grid[max(nearest - _COARSE + 1, 0) : nearest + _COARSE]
    cost, variance = profile(fine)
    best = int(np.argmin(cost))
    return float(np.sqrt(variance[best])), float(fine[best])


def _share_of_scatter(dimensions: IntArray, gate_chi2: float) -> float:
    """Return the share of the variance of normal errors of d dimensions (N,) that is left below a gate."""
    if not np.isfinite(gate_chi2) or not len(dimensions):
        return 1.0
    from scipy.special import gammainc

    half = np.asarray(dimensions) / 2
    left = gammainc(half + 1, gate_chi2 / 2) / gammainc(half, gate_chi2 / 2)
    return float(half @ left / half.sum())


def _pixel_variance(along2: FloatArray, rest: float, by_range: FloatArray, *, dof: int) -> FloatArray:
    """Return the maximum-likelihood pixel variance for each range noise, by fixed-point iteration."""
    variance = np.full(len(by_range), max((rest + along2.sum()) / dof, _MIN_PX**2))
    count, inverse = len(along2), np.empty_like(by_range)
    for _ in range(_ROUNDS):
        # expected contribution of pixel noise to the scatter along the line, given the current variances: the sum of
        # share^2 along2 + share by_range, with share = variance * inverse
        np.divide(1, np.add(variance[:, None], by_range, out=inverse), out=inverse)
        part = inverse.sum(axis=1)
        part -= np.multiply(inverse, inverse, out=inverse) @ along2
        part = variance * (count - variance * part)
        variance = np.maximum((rest + part) / dof, _MIN_PX**2)
    return variance
