"""Figures of a pose for comparison with other poses. Source: thesis Tables 3.2-3.5."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matches import count_picks
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan

_NAMES = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
_MOST_DECIMALS = 6


@dataclass(frozen=True, slots=True)
class Parameter:
    """One of the thesis's six parameters, rounded to its significant decimals."""

    name: str
    """Tx, Ty, Tz, alpha, beta or gamma."""
    unit: str
    """m or deg."""
    value: str
    """The value."""
    sigma: str
    """The standard deviation; `unknown` where there is none."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Agreement of the inliers with a pose; NaN where there are none."""

    matches: int
    """Number of matches; a line counts once."""
    inliers: int
    """Number of them that are inliers with all their parts."""
    median_px: float
    """Median pixel residual."""
    rms_px: float
    """Root mean square pixel residual."""
    rms_depth_m: float
    """Root mean square difference of laser and stereo depth, m."""


def figures(result: PoseResult) -> Figures:
    """Return the figures of a pose, over its inliers."""
    lengths = np.linalg.norm(result.residuals_px[result.inliers], axis=1)
    depth = result.stereo_depth_error_m[result.inliers]
    depth = depth[np.isfinite(depth)]
    inliers, matches = count_picks(result.matches, result.inliers)
    return Figures(
        matches,
        inliers,
        float(np.median(lengths)) if len(lengths) else math.nan,
        float(np.sqrt(np.mean(lengths**2))) if len(lengths) else math.nan,
        float(np.sqrt(np.mean(depth**2))) if len(depth) else math.nan,
    )


def parameters(result: PoseResult) -> tuple[Parameter, ...]:
    """Return Tx, Ty, Tz in m and alpha, beta, gamma in degrees, with two digits of their standard deviations.

    Empty for a pose that is refused and undetermined: its numbers mean nothing.
    """
    if not result.is_determined:
        return ()
    values, sigmas = result.thesis_parameters, result.thesis_sigmas
    found = []
    for name in _NAMES:
        value, sigma = getattr(values, name), getattr(sigmas, name)
        length = name.startswith("T")
        if not length:
            value, sigma = math.degrees(value), math.degrees(sigma)
        decimals = _decimals(sigma)
        sigma_text = f"{sigma:.{decimals}f}" if math.isfinite(sigma) else "unknown"
        found.append(Parameter(name, "m" if length else "deg", f"{value:.{decimals}f}", sigma_text))
    return tuple(found)


def pose_at_scanner(scan: Scan) -> Rigid:
    """Return the pose of a camera at the position of the scanner that looks along the mean direction of the scan."""
    return Rigid(look_along(scan.mean_direction), np.zeros(3))


def _decimals(sigma: float) -> int:
    if not (math.isfinite(sigma) and sigma > 0):
        return 4
    return min(max(1 - math.floor(math.log10(sigma)), 0), _MOST_DECIMALS)
