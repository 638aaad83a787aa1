"""Figures of a pose for comparison with other poses. Source: thesis Tables 3.2-3.5."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ladarreg_core.frames import Rigid, RoundedParameter, look_along
from ladarreg_core.matches import count_picks
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan


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


def parameters(result: PoseResult) -> tuple[RoundedParameter, ...]:
    """Return Tx, Ty, Tz in m and alpha, beta, gamma in degrees, with two digits of their standard deviations.

    Empty for a pose that is refused and undetermined: its numbers mean nothing.
    """
    if not result.is_determined:
        return ()
    return result.thesis_parameters.rounded(result.thesis_sigmas)


def pose_at_scanner(scan: Scan) -> Rigid:
    """Return the pose of a camera at the position of the scanner that looks along the mean direction of the scan."""
    return Rigid(look_along(scan.mean_direction), np.zeros(3))
