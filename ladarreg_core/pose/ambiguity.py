"""Ambiguity of a pose: second poses that explain the matches as well.

Candidates are the mirrored pose of a planar scene, poses around the matches from which refinement may end elsewhere,
and the pose on which the outliers agree.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two poses of a plane.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, principal_extents, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, AcceptanceOptions
from ladarreg_core.pose.estimators.bundle import (
    Descent,
    States,
    adjust_ranges,
    information_matrix,
    linearise,
    normal_equations,
    residuals,
    rotations_from_rotvecs,
)
from ladarreg_core.pose.estimators.gnc import graduate, narrow_scales, truncated_score
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.estimators.ransac import sample_pose
from ladarreg_core.pose.estimators.ray_ransac import sample_pose_of_rays

_ORBIT_RAD = np.deg2rad(20.0)
_ORBITS = 3
_SAMPLE = 20
_STEPS = 4  # starts that return to the pose found do so in three
_FRACTIONS_TO_MIRRORED = (0.25, 0.5, 0.75, 1.0)
_GENERALISED_STEPS, _MAX_ROTATION_RAD = 6, 0.3
_RANSAC_SIGMA = 6.0
_RANSAC_ITERATIONS = 500


def find_second_pose(
    measured: Measurements,
    best: States,
    inliers: BoolArray,
    *,
    s: FloatArray,
    gate: float,
    chi2_per_dof: float,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> Rigid | None:
    """Return a distinct pose whose likelihood is not clearly worse, or None.

    Args:
        measured: all matches.
        best: the pose found (B = 1).
        inliers: (N,) its inliers.
        s: (N,) cost of each match at that pose.
        gate: largest cost s of an inlier.
        chi2_per_dof: scale of score differences, if it exceeds 1.
        options: thresholds of a second pose.
    """
    pose, margin = best.pose(), options.second_pose_margin
    H = information_matrix(measured, best, members=inliers)[0]
    members = np.flatnonzero(inliers)
    sample = members[np.unique(np.linspace(0, len(members) - 1, _SAMPLE).astype(np.intp))]
    few = measured.subset(sample)
    noise = max(1.0, chi2_per_dof if np.isfinite(chi2_per_dof) else 1.0)
    points = (few.rays * few.ranges).T
    descent = Descent.start(few, States.of([mirrored(pose, points), *orbiting_poses(pose, points)], few))
    for _ in range(_STEPS):
        descent.step(lambda s: (np.ones_like(s), s.sum(axis=-1)))
    # a second pose may score worse by the margin on all matches, and by chance on a sample
    promising = truncated_score(descent.residuals.s, gate) < truncated_score(s[sample], gate) + (
        margin * noise + 4 * np.sqrt(4 * len(sample))
    )
    promising &= _distinct(pose, descent.states, H * (len(sample) / len(members)), options)
    if not promising.any():
        return None
    full = descent.states.subset(promising).with_ranges_of(measured)
    others, _ = graduate(measured, full, narrow_scales(full, gate), gate)
    scores = likelihood_scores(measured, others, gate)
    second = _distinct(pose, others, H, options) & (scores < likelihood_scores(measured, best, gate) + margin * noise)
    return others.pose(int(np.argmin(np.where(second, scores, np.inf)))) if second.any() else None


def likelihood_scores(measured: Measurements, states: States, gate: float) -> FloatArray:
    """Return -2 log likelihood (B,) of states up to a constant; an outlier counts as `gate`.

    The errors-in-variables cost alone favours cameras that see the range noise sideways, because the free ranges then
    absorb pixel residuals. The mirrored pose of a small plane can win that way (it did in 12 % of planes with unstated
    noise). The normaliser of the density, log(1 + sigma_r^2 j M j) per match, removes this bias.
    """
    seen = residuals(measured, states)
    freedom = np.log(linearise(measured, states, seen).h / measured.range_information)
    return np.asarray(truncated_score(seen.s, gate) + (freedom * (seen.s <= gate)).sum(axis=-1))


def mirrored(pose: Rigid, points: FloatArray) -> Rigid:
    """Return the second pose of a planar scene, which is indistinguishable from the first at a distance.

    Args:
        pose: camera_from_scanner.
        points: (N, 3), scanner frame, m; the pose is mirrored for their best-fitting plane.
    """
    centroid = points.mean(axis=0)
    centred = points - centroid
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    seen = pose @ centroid
    sight = seen / max(float(np.linalg.norm(seen)), 1e-12)
    # depths along the line of sight change sign; points of the plane keep their projection
    R = (np.eye(3) - 2 * np.outer(sight, sight)) @ pose.rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
    return Rigid(R, seen - R @ centroid)


def orbiting_poses(pose: Rigid, points: FloatArray) -> list[Rigid]:
    """Return poses whose camera moved by 20 degrees around the points and still looks at them.

    Args:
        pose: camera_from_scanner.
        points: (N, 3), scanner frame, m.
    """
    centroid = points.mean(axis=0)
    x, y, z = seen = pose @ centroid
    across = np.array([z, 0.0, -x]) if abs(y) <= abs(z) else np.array([y, -x, 0.0])  # any axis off the line of sight
    across = across / max(float(np.linalg.norm(across)), 1e-12)
    other = np.cross(seen / max(float(np.linalg.norm(seen)), 1e-12), across)
    angles = 2 * np.pi * np.arange(_ORBITS) / _ORBITS
    rotations = rotations_from_rotvecs(
        _ORBIT_RAD * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * other)
    )
    return [Rigid(R, seen - R @ centroid) for R in rotations @ pose.rotation]


def poses_towards_mirrored(pose: Rigid, points: FloatArray) -> list[Rigid]:
    """Return poses interpolated towards the mirrored one, with the points' centroid fixed in the image.

    If a plane is seen nearly face on, the two poses may merge into one minimum with a wide floor. A pose on that floor
    is ambiguous without being a minimum: it is six sigma away by the information and no worse by the likelihood.
    """
    centroid = points.mean(axis=0)
    seen = pose @ centroid
    rotvec = rotvec_from_rotation(mirrored(pose, points).rotation @ pose.rotation.T)
    rotations = [rotation_from_rotvec(fraction * rotvec) @ pose.rotation for fraction in _FRACTIONS_TO_MIRRORED]
    return [Rigid(R, seen - R @ centroid) for R in rotations]


def refine_generalised(measured: Measurements, states: States, gate: float) -> States:
    """Refine states by generalised least squares: ranges as measured, with their noise propagated into the pixels.

    The errors-in-variables minimum of a small plane may lie degrees away from that of the likelihood, because of the
    bias described in `likelihood_scores`. Generalised least squares does not have that bias.
    """
    members = (residuals(measured, states).s <= gate).astype(np.float64)
    moving = states
    for _ in range(_GENERALISED_STEPS):
        moving = moving.with_ranges_of(measured)
        seen = residuals(measured, moving)
        H, g = normal_equations(measured, seen, linearise(measured, moving, seen), members)
        diagonal = np.einsum("bii->bi", H)
        diagonal += 1e-9 * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        step = np.nan_to_num(np.linalg.solve(H, g[..., None])[..., 0])
        length = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step = step * np.minimum(1, _MAX_ROTATION_RAD / np.maximum(length, 1e-300))
        moving = States(
            rotations_from_rotvecs(step[:, :3]) @ moving.rotations, moving.centres + step[:, 3:], moving.rho
        )
    return adjust_ranges(measured, moving.with_ranges_of(measured))[0]


def pose_of_outliers(
    matches: Matches,
    measured: Measurements,
    others: BoolArray,
    camera: CameraModel,
    *,
    sigma_px: float,
    seed: int = 0,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> Rigid | None:
    """Return a pose on which some of the outliers of another pose agree; None if they are too few to matter.

    Outliers agree with each other in repeated structure, for example when shifted by one window or shelf.

    Args:
        matches: M matches.
        measured: the same matches.
        others: (M,) the outliers.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        seed: random seed.
        options: thresholds of a second pose.
    """
    count = int(np.count_nonzero(others))
    if count < least_support(len(others) - count, options):
        return None
    pinhole = camera.as_pinhole
    if pinhole is None:
        return sample_pose_of_rays(
            matches.points[others], camera.unproject(matches.uv[others]),
            threshold_rad=_RANSAC_SIGMA * sigma_px / camera.focal_px, iterations=_RANSAC_ITERATIONS, seed=seed,
        )  # fmt: skip
    ideal = pinhole.without_distortion()
    uv = (measured.xy[:, others] * [[ideal.fx], [ideal.fy]] + [[ideal.cx], [ideal.cy]]).T
    return sample_pose(
        matches.points[others], uv, ideal, threshold_px=_RANSAC_SIGMA * sigma_px, iterations=_RANSAC_ITERATIONS,
        seed=seed,
    )  # fmt: skip


def second_pose_of_outliers(
    matches: Matches,
    measured: Measurements,
    inliers: BoolArray,
    camera: CameraModel,
    *,
    sigma_px: float,
    gate: float,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> Rigid | None:
    """Return a pose supported by at least `least_support` of the outliers, or None.

    Args:
        matches: M matches.
        measured: the same matches.
        inliers: (M,) inliers of the pose found.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        gate: largest cost s of an inlier.
        options: thresholds of a second pose.
    """
    pose = pose_of_outliers(matches, measured, ~inliers, camera, sigma_px=sigma_px, options=options)
    if pose is None:
        return None
    agree = count_rivals(pose, measured, inliers, gate=gate)
    return pose if agree >= least_support(int(np.count_nonzero(inliers)), options) else None


def count_rivals(pose: Rigid, measured: Measurements, inliers: BoolArray, *, gate: float) -> int:
    """Return the number of matches that agree with a pose and are not inliers (M,) of the first one."""
    _, seen = adjust_ranges(measured, States.of([pose], measured))
    return int(np.count_nonzero((seen.s[0] <= gate) & ~inliers))


def is_planar(points: FloatArray, options: AcceptanceOptions = DEFAULT_ACCEPTANCE) -> bool:
    """Return whether points (N, 3) have so little relief that a mirrored pose may explain them."""
    extents = principal_extents(points)
    return bool(extents[2] <= options.planar_relief * extents[1])


def least_support(inliers: int, options: AcceptanceOptions = DEFAULT_ACCEPTANCE) -> int:
    """Return the number of outliers that must agree on a second pose, given the inliers of the first."""
    return max(options.least_rivals, int(np.ceil(options.rival_share * inliers)))


def pose_differences(pose: Rigid, states: States) -> tuple[FloatArray, FloatArray]:
    """Return the differences (w, c) (B, 6) from a pose to states, and the angles (B,) between them, rad.

    The length of w is the sine of the angle, which is exact enough for small angles.
    """
    relative = states.rotations @ pose.rotation.T
    w = 0.5 * np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    return np.concatenate([w, states.centres - pose.centre], axis=1), np.arctan2(np.linalg.norm(w, axis=1), cosine)


def _distinct(pose: Rigid, states: States, H: FloatArray, options: AcceptanceOptions) -> BoolArray:
    step, angle = pose_differences(pose, states)
    far = np.einsum("bi,ij,bj->b", step, H, step) > options.second_pose_sigmas**2
    return np.asarray(far | (angle > np.pi / 2))
