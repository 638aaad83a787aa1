"""Whether another pose explains the matches as well: the mirrored one of a plane, or any that nearby starts reach.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two-fold ambiguity.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import (
    Descent,
    Measurements,
    States,
    information_matrix,
    linearise,
    normal_equations,
    residuals,
    rotations_from_rotvecs,
    settle,
)
from ladarreg_core.pose.gnc import graduate, narrow_scales, truncated_score
from ladarreg_core.pose.ransac import sample_pose

LIKELY = 16.0
"""A rise of the score that tells two poses apart: four sigma."""
APART_SIGMA = 6.0
"""Poses further apart than this many standard deviations are different ones."""
_ORBIT_RAD = np.deg2rad(20.0)
_ORBITS = 3
_SAMPLE = 20
_STEPS = 4  # starts that come home are there after three
_ON_THE_WAY = (0.25, 0.5, 0.75, 1.0)
_GENERALISED_STEPS, _MOST_TURN_RAD = 6, 0.3
_RANSAC_SIGMA = 6.0
_RANSAC_ITERATIONS = 500
_RIVAL_SHARE, _LEAST_RIVAL = 0.5, 5


def competing_pose(
    measured: Measurements, best: States, inliers: BoolArray, *, s: FloatArray, gate: float, chi2_per_dof: float
) -> Rigid | None:
    """Return another pose whose likelihood is not clearly worse, or None.

    Args:
        measured: all matches.
        best: the state found (B = 1).
        inliers: (N,) its inliers.
        s: (N,) the cost of each match there.
        gate: largest s of an inlier.
        chi2_per_dof: by which differences of scores are judged, where it exceeds 1.
    """
    pose = best.pose()
    H = information_matrix(measured, best, members=inliers)[0]
    members = np.flatnonzero(inliers)
    sample = members[np.unique(np.linspace(0, len(members) - 1, _SAMPLE).astype(np.intp))]
    few = measured.subset(sample)
    noise = max(1.0, chi2_per_dof if np.isfinite(chi2_per_dof) else 1.0)
    points = (few.rays * few.ranges).T
    descent = Descent.start(few, States.of([mirrored(pose, points), *orbits(pose, points)], few))
    for _ in range(_STEPS):
        descent.step(np.ones_like, _total)
    # A rival's score over all matches may be higher by LIKELY, on a sample also by chance.
    worth = truncated_score(descent.seen.s, gate) < truncated_score(s[sample], gate) + (
        LIKELY * noise + 4 * np.sqrt(4 * len(sample))
    )
    worth &= _apart(pose, descent.states, H * (len(sample) / len(members)))
    if not worth.any():
        return None
    full = descent.states.subset(worth).seeing(measured)
    others, _ = graduate(measured, full, narrow_scales(full, gate), gate)
    scores = likelihood_scores(measured, others, gate)
    rivals = _apart(pose, others, H) & (scores < likelihood_scores(measured, best, gate) + LIKELY * noise)
    return others.pose(int(np.argmin(np.where(rivals, scores, np.inf)))) if rivals.any() else None


def likelihood_scores(measured: Measurements, states: States, gate: float) -> FloatArray:
    """Return -2 log likelihood (B,) of states but for a constant, a mismatch counting as `gate`.

    The errors-in-variables cost alone favours a camera that sees the ranges' noise across: a free range then takes
    what is left of the pixel. A small plane's mirrored pose can win by that, as it did against 12 % of the right poses
    of planes whose noise was not stated; the density's normaliser, log(1 + sigma_r^2 j M j) a match, takes it back.
    """
    seen = residuals(measured, states)
    freedom = np.log(linearise(measured, states, seen).h / measured.range_information)
    return np.asarray(truncated_score(seen.s, gate) + (freedom * (seen.s <= gate)).sum(axis=-1))


def mirrored(pose: Rigid, points: FloatArray) -> Rigid:
    """Return the pose that a flat scene, seen from afar, cannot be told from.

    Args:
        pose: camera_from_scanner.
        points: (N, 3), scanner frame, m; their best plane is meant.
    """
    centroid = points.mean(axis=0)
    centred = points - centroid
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    seen = pose @ centroid
    sight = seen / max(float(np.linalg.norm(seen)), 1e-12)
    # Depths along the line of sight change sign, points of the plane stay where they are seen.
    R = (np.eye(3) - 2 * np.outer(sight, sight)) @ pose.rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
    return Rigid(R, seen - R @ centroid)


def orbits(pose: Rigid, points: FloatArray) -> list[Rigid]:
    """Return poses whose camera went round the points by 20 degrees, which stay in its view.

    Args:
        pose: camera_from_scanner.
        points: (N, 3), scanner frame, m.
    """
    centroid = points.mean(axis=0)
    x, y, z = seen = pose @ centroid
    across = np.array([z, 0.0, -x]) if abs(y) <= abs(z) else np.array([y, -x, 0.0])  # not along the line of sight
    across = across / max(float(np.linalg.norm(across)), 1e-12)
    other = np.cross(seen / max(float(np.linalg.norm(seen)), 1e-12), across)
    angles = 2 * np.pi * np.arange(_ORBITS) / _ORBITS
    turns = rotations_from_rotvecs(_ORBIT_RAD * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * other))
    return [Rigid(R, seen - R @ centroid) for R in turns @ pose.rotation]


def towards_mirrored(pose: Rigid, points: FloatArray) -> list[Rigid]:
    """Return poses on the way to the mirrored one, which keep the points' middle where it is seen.

    Where a plane is seen nearly face on both poses may have grown together to one minimum with a wide floor. They need
    not be minima to tell: six sigma away by the information, and no worse by the likelihood, is another place.
    """
    centroid = points.mean(axis=0)
    seen = pose @ centroid
    turn = rotvec_from_rotation(mirrored(pose, points).rotation @ pose.rotation.T)
    turned = [rotation_from_rotvec(share * turn) @ pose.rotation for share in _ON_THE_WAY]
    return [Rigid(R, seen - R @ centroid) for R in turned]


def generalised(measured: Measurements, states: States, gate: float) -> States:
    """Return where generalised least squares leads from states: the ranges as measured, their noise in the pixels.

    The errors-in-variables minimum of a small plane may lie degrees beside the likelihood's, since it gains by seeing
    the ranges' noise across (`likelihood_scores`); here nothing is gained by that.
    """
    members = (residuals(measured, states).s <= gate).astype(np.float64)
    moving = states
    for _ in range(_GENERALISED_STEPS):
        moving = moving.seeing(measured)
        seen = residuals(measured, moving)
        H, g = normal_equations(measured, seen, linearise(measured, moving, seen), members)
        diagonal = np.einsum("bii->bi", H)
        diagonal += 1e-9 * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        step = np.nan_to_num(np.linalg.solve(H, g[..., None])[..., 0])
        length = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step = step * np.minimum(1, _MOST_TURN_RAD / np.maximum(length, 1e-300))
        moving = States(
            rotations_from_rotvecs(step[:, :3]) @ moving.rotations, moving.centres + step[:, 3:], moving.rho
        )
    return settle(measured, moving.seeing(measured))[0]


def pose_of_the_others(
    matches: Matches, measured: Measurements, others: BoolArray, camera: Camera, *, sigma_px: float, seed: int = 0
) -> Rigid | None:
    """Return a pose of matches that disagree with another, where they are enough to matter.

    Args:
        matches: M matches.
        measured: the same.
        others: (M,) those that disagree.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        seed: of the samples.
    """
    count = int(np.count_nonzero(others))
    if count < least_rival(len(others) - count):
        return None
    ideal = camera.without_distortion()
    uv = (measured.xy[:, others] * [[ideal.fx], [ideal.fy]] + [[ideal.cx], [ideal.cy]]).T
    return sample_pose(
        matches.points[others], uv, ideal, threshold_px=_RANSAC_SIGMA * sigma_px, iterations=_RANSAC_ITERATIONS,
        seed=seed,
    )  # fmt: skip


def rival_of_the_others(
    matches: Matches, measured: Measurements, inliers: BoolArray, camera: Camera, *, sigma_px: float, gate: float
) -> Rigid | None:
    """Return a pose that half as many of the other matches agree on as agree with the pose found, or None.

    Args:
        matches: M matches.
        measured: the same.
        inliers: (M,) those that agree with the pose found.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        gate: largest s of a match that agrees.
    """
    pose = pose_of_the_others(matches, measured, ~inliers, camera, sigma_px=sigma_px)
    if pose is None:
        return None
    _, seen = settle(measured, States.of([pose], measured))
    agree = int(np.count_nonzero((seen.s[0] <= gate) & ~inliers))
    return pose if agree >= least_rival(int(np.count_nonzero(inliers))) else None


def least_rival(agree: int) -> int:
    """Return how many other matches must agree on another pose to be no chance beside these."""
    return max(_LEAST_RIVAL, int(np.ceil(_RIVAL_SHARE * agree)))


def steps_from(pose: Rigid, states: States) -> tuple[FloatArray, FloatArray]:
    """Return (w, c) (B, 6) from a pose to states, and the angles (B,) between them, rad.

    The length of w is the sine of the angle: enough where the angle is small, and what is far by it is far.
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


def _apart(pose: Rigid, states: States, H: FloatArray) -> BoolArray:
    step, angle = steps_from(pose, states)
    far = np.einsum("bi,ij,bj->b", step, H, step) > APART_SIGMA**2
    return np.asarray(far | (angle > np.pi / 2))


def _total(s: FloatArray) -> FloatArray:
    return np.asarray(s.sum(axis=-1))
