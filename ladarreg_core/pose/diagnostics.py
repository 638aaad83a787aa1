"""Diagnostics of a pose beside its residuals: shape of the scene, baseline, disparity and stereo depth error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, median
from ladarreg_core.frames import Rigid, principal_extents
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.stereo import STEREO_AXES_FROM_SCANNER, StereoPairs, rectify, stereo_frame

_MIN_DISPARITY_SIGMA = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Disparities:
    """Quantities of the stereo equations for M matches; NaN for points not in front of both scanner and camera."""

    frame_from_scanner: FloatArray
    """(3, 3) of `stereo_frame`."""
    depth: FloatArray
    """(M,) laser depth, m."""
    disparity: FloatArray
    """(2, M) after derotation, tangents."""
    numerator: FloatArray
    """(2, M) Z times the disparity by Eq 2.17-2.18, lambda = 1, m."""


def stereo_depth_error(
    pose: Rigid, matches: Matches, camera: CameraModel, *, sigma_px: float, disparities: Disparities | None = None
) -> FloatArray:
    """Return laser depth minus stereo depth of every match, in the thesis's stereo frame.

    Depth is measured along the scanner's X, or along the mean ray if the matches lie to the side; see `stereo_frame`.
    The stereo depths from x and y disparity are averaged, weighted by the squared disparities. This mean is invariant
    to rotation about the optical axis, so the thesis's 45 degree rotation (Eq 2.14-2.16), which keeps both disparities
    from vanishing, is not needed.

    Args:
        pose: camera_from_scanner.
        matches: M matches.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        disparities: the disparities of this pose if already computed.

    Returns:
        (M,) m; NaN if the point is not in front, or if the disparity is within three sigma_px of zero, as for a
        baseline of zero.

    Source: thesis Eq 2.19-2.21.
    """
    d = disparities or stereo_disparities(pose, matches, camera)
    disparity, numerator = d.disparity, d.numerator
    squared = (disparity * disparity).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        stereo = (disparity * numerator).sum(axis=0) / squared
        known = np.sqrt(squared) * camera.focal_px > _MIN_DISPARITY_SIGMA * sigma_px
    return np.where(known, d.depth - stereo, np.nan)


def stereo_disparities(pose: Rigid, matches: Matches, camera: CameraModel) -> Disparities:
    """Return the disparities of matches for a pose."""
    frame_from_scanner = stereo_frame(matches.rays)
    pairs = StereoPairs.of(matches, camera, frame_from_scanner=frame_from_scanner)
    Tx, Ty, Tz, alpha, beta, gamma = pairs.parameters(pose).tolist()
    with np.errstate(divide="ignore", invalid="ignore"):
        rectified = np.stack(rectify(pairs.color[0], pairs.color[1], alpha=alpha, beta=beta, gamma=gamma))
    depth = np.where(pairs.depth > 0, pairs.depth, np.nan)
    disparity = np.where(pairs.ahead(pose) & (pairs.depth > 0), rectified - pairs.laser, np.nan)
    return Disparities(frame_from_scanner, depth, disparity, np.array([[Tx], [Ty]]) + Tz * rectified)


def diagnose(
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: CameraModel,
    *,
    sigma_px: float,
    disparities: Disparities | None = None,
) -> dict[str, Any]:
    """Return figures of the inliers' shape, baseline and disparity, JSON-ready.

    `planarity` is the smallest over the middle singular value of the centred points (0: a plane), `linearity` the
    middle over the largest (0: a line). The stereo methods fail if `stereo_sigma_z_over_z` exceeds .05 or
    `disparity_over_sigma` falls below 40.
    """
    points, ranges, uv = matches.points[inliers], matches.ranges[inliers], matches.uv[inliers]
    figures: dict[str, Any] = {"matches": len(matches), "inliers": len(points)}
    d = disparities or stereo_disparities(pose, matches, camera)
    left, up, forward = (float(v) for v in STEREO_AXES_FROM_SCANNER @ d.frame_from_scanner @ pose.centre)
    figures |= {
        "baseline_m": float(np.linalg.norm(pose.centre)),
        "baseline_across_m": float(np.hypot(left, up)),
        "baseline_forward_m": forward,
    }
    if len(points) < 2:
        return figures
    s = principal_extents(points)
    figures["planarity"] = float(s[2] / s[1]) if s[1] > 0 else 0.0
    figures["linearity"] = float(s[1] / s[0]) if s[0] > 0 else 0.0
    figures["range_near_m"], figures["range_far_m"] = float(ranges.min()), float(ranges.max())
    wide, high = ((uv.max(axis=0) - uv.min(axis=0)) / camera.size).tolist()
    figures["spread_of_picture"] = min(wide, 1.0) * min(high, 1.0)
    x, y = d.disparity[:, inliers]
    length = np.sqrt(x * x + y * y)
    length = length[~np.isnan(length)]
    if len(length):
        middle = median(length) * camera.focal_px
        figures["disparity_median_px"] = middle
        figures["disparity_over_sigma"] = middle / sigma_px
        if middle > 0:
            figures["stereo_sigma_z_over_z"] = float(np.sqrt(2) * sigma_px / middle)
    return figures
