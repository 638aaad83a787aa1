"""The figures of a pose that was found in another way than from its matches."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, across_lines
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, settle
from ladarreg_core.pose.diagnostics import diagnose, stereo_depth_error
from ladarreg_core.results import PoseResult


def describe_pose(
    camera_from_scanner: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: Camera,
    *,
    sigma_px: float,
    sigma_range_m: float,
    covariance: FloatArray,
) -> PoseResult:
    """Return residuals and diagnostics of a given pose, unjudged (`accepted` is False).

    Args:
        camera_from_scanner: the pose.
        matches: M matches; may be none.
        inliers: (M,) bool.
        camera: the photo's camera.
        sigma_px: pixel noise.
        sigma_range_m: range noise, m.
        covariance: (6, 6) as `PoseResult.covariance`.
    """
    pose, count = camera_from_scanner, len(matches)
    adjusted, s = np.full(count, np.nan), np.zeros(count)
    if count:
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        states, seen = settle(measured, States.of([pose], measured))
        s = seen.s[0]
        adjusted = np.where(s < UNSEEN, states.rho[0], np.nan)
    dof = int(matches.dimensions[inliers].sum()) - 6
    return PoseResult(
        camera_from_scanner=pose,
        camera=camera,
        matches=matches,
        inliers=inliers,
        residuals_px=across_lines(matches, matches.uv - camera.project(pose @ matches.points)),
        residuals_m=matches.ranges - adjusted,
        stereo_depth_error_m=stereo_depth_error(pose, matches, camera, sigma_px=sigma_px),
        covariance=covariance,
        chi2_per_dof=float(s[inliers].sum() / dof) if dof > 0 else float("nan"),
        sigma_px=float(sigma_px),
        sigma_range_m=float(sigma_range_m),
        diagnostics=diagnose(pose, matches, inliers, camera, sigma_px=sigma_px),
    )
