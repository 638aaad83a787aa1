"""Conditions under which the thesis's methods fail, recognised in the matches before solving.

Source: thesis 3.4: too little disparity at nearly the same position (Figure 3.19), and images rotated about their
optical axes (Figure 3.20); few and clustered matches make either worse.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import CameraModel, require_camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_positive, require_type
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters, principal_extents
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, count_distinct
from ladarreg_core.pose.estimators.ransac import ransac_pose
from ladarreg_core.quality.limits import (
    LARGE_ROLL_RAD,
    LITTLE_SPREAD,
    covered_share,
    has_usable_parallax,
    is_forward_baseline,
)
from ladarreg_core.thesis.estimators.linear import MIN_PLANARITY
from ladarreg_core.thesis.estimators.starts import picture_roll
from ladarreg_core.thesis.estimators.stereo import StereoPairs

_RANSAC_SIGMA, _MIN_AGREEING, _MIN_AGREEING_SHARE = 6.0, 8, 0.3
_MAX_SIGMA_PX = 1e6


def stereo_cautions(
    matches: Matches,
    camera: CameraModel,
    *,
    pose: Rigid | None = None,
    sigma_px: float = 1.0,
    view_from_scanner: Rigid | None = None,
) -> tuple[str, ...]:
    """Return warnings on the linear and the stereo methods for these matches, as sentences; none means no concern.

    Args:
        matches: M matches, possibly with outliers.
        camera: the photo's camera.
        pose: camera_from_scanner, if roughly known; None: the one on which enough matches agree, if any.
        sigma_px: pixel noise, px.
        view_from_scanner: view of the scan in which the matches were found, to which the roll of the photo refers;
            None: one that looks along the scanner's X axis, or at the matches.

    Raises:
        CameraError: if `camera` is not a `Camera`.
        OptionError: if `sigma_px` is not a positive number, or a pose is not a `Rigid`.
    """
    require_camera(camera, "the camera")
    require_positive(sigma_px, "sigma_px", most=_MAX_SIGMA_PX, unit="pixels")
    for name, transform in (("pose", pose), ("view_from_scanner", view_from_scanner)):
        if transform is not None:
            require_type(transform, Rigid, f"the {name}")
    matches = matches.subset(
        np.isfinite(np.column_stack([matches.rays, matches.ranges, matches.uv])).all(axis=1) & (matches.ranges > 0)
    )
    frame = None if view_from_scanner is None else CAMERA_AXES_FROM_SCANNER.T @ view_from_scanner.rotation
    pairs = StereoPairs.of(matches, camera, frame_from_scanner=frame)
    matches, pairs = matches.subset(pairs.usable), pairs.subset(pairs.usable)
    found = [_count(matches)]
    if len(matches):
        found += [_spread(matches, camera), _relief(matches)]
        known = pose or _consensus_pose(matches, camera, float(sigma_px))
        if known is None:
            found.append(_roll(picture_roll(pairs.laser, pairs.color, pairs.depth)))
        else:
            found += [_baseline(known, pairs, camera, float(sigma_px)), _direction(known, pairs)]
            found.append(_roll(float(pairs.parameters(known)[5])))
    return tuple(sentence for sentence in found if sentence)


def _count(matches: Matches) -> str:
    count = count_distinct(matches.points, matches.uv) if len(matches) else 0
    least = DEFAULT_ACCEPTANCE.least_inliers()
    if count >= least:
        return ""
    return (
        f"Distinct matches with a usable range: {count}. With fewer than {least}, outliers cannot be "
        "recognised; add matches by hand or detect more corners."
    )


def _spread(matches: Matches, camera: CameraModel) -> str:
    share = covered_share(matches.uv, camera)
    if share >= LITTLE_SPREAD[1]:
        return ""
    return (
        f"The matches cover only {share:.0%} of the photo, so that small errors in them shift the camera far. "
        "Add matches in the rest of the photo."
    )


def _relief(matches: Matches) -> str:
    extents = principal_extents(matches.points)
    if extents[2] >= MIN_PLANARITY * extents[1]:
        return ""
    return (
        f"The matches lie near one plane (relief {extents[2] / max(float(extents[1]), 1e-300):.2f} of their width, the "
        f"linear method needs {MIN_PLANARITY:g}). Add matches off that plane, or give an initial pose."
    )


def _consensus_pose(matches: Matches, camera: CameraModel, sigma_px: float) -> Rigid | None:
    """Return the pose on which enough matches agree, by RANSAC."""
    pinhole = camera.as_pinhole
    if pinhole is None:
        return None
    found = ransac_pose(matches.points, matches.uv, pinhole, threshold_px=_RANSAC_SIGMA * sigma_px, iterations=1000)
    if found is None:
        return None
    agreeing = np.count_nonzero(found.inliers)
    enough = agreeing >= max(_MIN_AGREEING, _MIN_AGREEING_SHARE * len(matches))
    return found.camera_from_scanner if enough else None


def _baseline(pose: Rigid, pairs: StereoPairs, camera: CameraModel, sigma_px: float) -> str:
    disparity = _predicted_disparity(pose, pairs) * camera.focal_px
    if not np.isfinite(disparity).any():
        return ""
    median = float(np.nanmedian(disparity))
    relative_sigma = np.sqrt(2) * sigma_px / max(median, 1e-12)
    if has_usable_parallax(median / sigma_px, relative_sigma):
        return ""
    depth = f"uncertain by {relative_sigma:.0%}" if relative_sigma < 1 else "undetermined"
    return (
        f"Scanner and camera are nearly at the same position: the parallax of the matches is {median:.1f} px, which "
        f"leaves stereo depths {depth}. Take the photo from further to the side, or use the 'robust' method, which "
        "needs no baseline."
    )


def _direction(pose: Rigid, pairs: StereoPairs) -> str:
    Tx, Ty, Tz = pairs.parameters(pose)[:3]
    across = float(np.hypot(Tx, Ty))
    reach = float(np.median(pairs.depth))
    if not is_forward_baseline(across, Tz) or np.hypot(across, Tz) < 0.01 * reach:
        return ""
    return (
        f"The camera is {'in front of' if Tz > 0 else 'behind'} the scanner and hardly beside it ({across:.2f} m "
        f"across, {abs(Tz):.2f} m along), so that disparities vanish in the middle of the photo. Take the photo from "
        "further to the side, or use the 'robust' method."
    )


def _roll(roll: float | None) -> str:
    if roll is None or abs(roll) <= LARGE_ROLL_RAD:
        return ""
    direction = "clockwise" if roll > 0 else "counter-clockwise"
    return (
        f"The photo is rolled by {abs(np.degrees(roll)):.0f} deg {direction} relative to the scan, and correlation "
        "windows are not rotated. Rotate the photo upright first, or pick the matches by hand."
    )


def _predicted_disparity(pose: Rigid, pairs: StereoPairs) -> FloatArray:
    """Return the length (M,) of the disparity of each match, predicted from the pose and its range, lambda = 1."""
    p = ThesisParameters(*map(float, pairs.parameters(pose)))
    points = np.vstack([-pairs.laser * pairs.depth, pairs.depth])
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(points[2] > p.Tz, points[2] - p.Tz, np.nan)
        rectified = -(points[:2] - np.array([[p.Tx], [p.Ty]])) / ahead
    return np.asarray(np.linalg.norm(rectified - pairs.laser, axis=0))
