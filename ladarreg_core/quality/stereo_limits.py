"""Where the thesis's methods fail, recognised before they solve.

Source: thesis 3.4: too little disparity at nearly the same place (Figure 3.19), and pictures turned about their optical
axes (Figure 3.20); few and clustered matches make either worse.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, OptionError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters, principal_extents
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import LEAST_INLIERS, count_distinct
from ladarreg_core.pose.ransac import ransac_pose
from ladarreg_core.pose.thesis.linear import LEAST_PLANARITY
from ladarreg_core.pose.thesis.starts import picture_roll
from ladarreg_core.pose.thesis.stereo import StereoPairs

MOST_SIGMA_Z_OVER_Z = 0.05
"""Above this a stereo depth is too uncertain to be compared with the laser's."""
LEAST_DISPARITY_SIGMA = 40.0
"""Below this many sigma_px of stereo_disparities disparity, likewise."""
LARGE_ROLL_RAD = np.deg2rad(20.0)
"""Correlation windows are not turned; beyond this they no longer look alike."""
LEAST_ACROSS_OF_FORWARD = 0.25
"""Below this ratio of |(Tx, Ty)| to |Tz| the disparities vanish inside the picture."""
_LEAST_SPREAD = 0.1  # of the picture's area
_WITHIN = (5.0, 95.0)  # per cent: a few mismatches elsewhere spread nothing
_RANSAC_SIGMA, _LEAST_AGREEING, _LEAST_AGREEING_SHARE = 6.0, 8, 0.3
_MOST_SIGMA_PX = 1e6


def stereo_cautions(
    matches: Matches,
    camera: Camera,
    *,
    pose: Rigid | None = None,
    sigma_px: float = 1.0,
    view_from_scanner: Rigid | None = None,
) -> tuple[str, ...]:
    """Return what is to be feared of the linear and the stereo methods on these matches, in sentences; none is good.

    Args:
        matches: M matches, mismatches among them.
        camera: the photo's camera.
        pose: camera_from_scanner, where it is known roughly; None: the one that most matches agree on, if any does.
        sigma_px: pixel noise, px.
        view_from_scanner: the scan's view in which the matches were found, against which the photo's roll is meant;
            None: one that looks along the scanner's X, or at the matches.

    Raises:
        CameraError: if `camera` is none.
        OptionError: if `sigma_px` is not a positive number, or a pose is no `Rigid`.
    """
    if not isinstance(camera, Camera):
        raise CameraError(f"the camera is a {type(camera).__name__}; give a Camera")
    number = isinstance(sigma_px, int | float | np.floating | np.integer) and not isinstance(sigma_px, bool)
    if not number or not 0 < sigma_px < _MOST_SIGMA_PX:
        raise OptionError(f"sigma_px is {sigma_px!r}; it must be a positive number of pixels")
    for name, transform in (("pose", pose), ("view_from_scanner", view_from_scanner)):
        if transform is not None and not isinstance(transform, Rigid):
            raise OptionError(f"the {name} is a {type(transform).__name__}; give a Rigid")
    matches = matches.subset(
        np.isfinite(np.column_stack([matches.rays, matches.ranges, matches.uv])).all(axis=1) & (matches.ranges > 0)
    )
    frame = None if view_from_scanner is None else CAMERA_AXES_FROM_SCANNER.T @ view_from_scanner.rotation
    pairs = StereoPairs.of(matches, camera, frame_from_scanner=frame)
    matches, pairs = matches.subset(pairs.usable), pairs.subset(pairs.usable)
    found = [_count(matches)]
    if len(matches):
        found += [_spread(matches, camera), _relief(matches)]
        known = pose or _agreed(matches, camera, float(sigma_px))
        if known is None:
            found.append(_roll(picture_roll(pairs.laser, pairs.colour, pairs.depth)))
        else:
            found += [_baseline(known, pairs, camera, float(sigma_px)), _direction(known, pairs)]
            found.append(_roll(float(pairs.parameters(known)[5])))
    return tuple(sentence for sentence in found if sentence)


def _count(matches: Matches) -> str:
    count = count_distinct(matches.points, matches.uv) if len(matches) else 0
    if count >= LEAST_INLIERS:
        return ""
    return (
        f"Different matches with a usable range: {count}. With fewer than {LEAST_INLIERS} no mismatch stands out; add "
        "matches by hand or detect more corners."
    )


def _spread(matches: Matches, camera: Camera) -> str:
    low, high = np.percentile(matches.uv, _WITHIN, axis=0)
    share = float(np.clip((high - low) / camera.size, 0, 1).prod()) / ((_WITHIN[1] - _WITHIN[0]) / 100) ** 2
    if share >= _LEAST_SPREAD:
        return ""
    return (
        f"The matches cover only {share:.0%} of the photo, so that a small error in them moves the camera far. "
        "Add matches in the rest of the picture."
    )


def _relief(matches: Matches) -> str:
    extents = principal_extents(matches.points)
    if extents[2] >= LEAST_PLANARITY * extents[1]:
        return ""
    return (
        f"The matches lie near one plane (relief {extents[2] / max(float(extents[1]), 1e-300):.2f} of their width, the "
        f"linear method needs {LEAST_PLANARITY:g}). Add matches off that plane, or give a first pose."
    )


def _agreed(matches: Matches, camera: Camera, sigma_px: float) -> Rigid | None:
    """Return the pose that enough matches agree on."""
    found = ransac_pose(matches.points, matches.uv, camera, threshold_px=_RANSAC_SIGMA * sigma_px, iterations=1000)
    if found is None:
        return None
    agreeing = np.count_nonzero(found.inliers)
    enough = agreeing >= max(_LEAST_AGREEING, _LEAST_AGREEING_SHARE * len(matches))
    return found.camera_from_scanner if enough else None


def _baseline(pose: Rigid, pairs: StereoPairs, camera: Camera, sigma_px: float) -> str:
    disparity = _predicted_disparity(pose, pairs) * camera.focal_px
    if not np.isfinite(disparity).any():
        return ""
    median = float(np.nanmedian(disparity))
    uncertain = np.sqrt(2) * sigma_px / max(median, 1e-12)
    if uncertain <= MOST_SIGMA_Z_OVER_Z and median >= LEAST_DISPARITY_SIGMA * sigma_px:
        return ""
    depth = f"known to {uncertain:.0%}" if uncertain < 1 else "unknown"
    return (
        f"Scanner and camera stand nearly at the same place: the parallax of the matches is {median:.1f} px, which "
        f"leaves stereo depths {depth}. Take the photo from further aside, or use the 'robust' method, which needs no "
        "baseline."
    )


def _direction(pose: Rigid, pairs: StereoPairs) -> str:
    Tx, Ty, Tz = pairs.parameters(pose)[:3]
    across = float(np.hypot(Tx, Ty))
    reach = float(np.median(pairs.depth))
    if across >= LEAST_ACROSS_OF_FORWARD * abs(Tz) or np.hypot(across, Tz) < 0.01 * reach:
        return ""
    return (
        f"The camera stands {'in front of' if Tz > 0 else 'behind'} the scanner and hardly beside it ({across:.2f} m "
        f"across, {abs(Tz):.2f} m along), where disparities vanish in the middle of the picture. Take the photo from "
        "the side, or use the 'robust' method."
    )


def _roll(roll: float | None) -> str:
    if roll is None or abs(roll) <= LARGE_ROLL_RAD:
        return ""
    way = "clockwise" if roll > 0 else "counter-clockwise"
    return (
        f"The photo is rolled by {abs(np.degrees(roll)):.0f} deg {way} against the scan, and windows that are not "
        "turned hardly correlate. Turn the photo upright first, or pick the matches by hand."
    )


def _predicted_disparity(pose: Rigid, pairs: StereoPairs) -> FloatArray:
    """Return the length (M,) of each match's disparity as the pose and its range foretell it, lambda = 1."""
    p = ThesisParameters(*map(float, pairs.parameters(pose)))
    points = np.vstack([-pairs.laser * pairs.depth, pairs.depth])
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(points[2] > p.Tz, points[2] - p.Tz, np.nan)
        rectified = -(points[:2] - np.array([[p.Tx], [p.Ty]])) / ahead
    return np.asarray(np.linalg.norm(rectified - pairs.laser, axis=0))
