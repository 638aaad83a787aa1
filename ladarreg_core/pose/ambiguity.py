"""Whether another pose explains the matches as well: the mirrored one of a plane, or any that nearby starts reach.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two-fold ambiguity.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.pose.bundle import Descent, Measurements, States, information_matrix, settle
from ladarreg_core.pose.gnc import graduate, narrow_scales, truncated_score

_ORBIT_RAD = np.deg2rad(40.0)
_ORBITS = 3
_SAMPLE = 20
_STEPS = 6  # starts that come home are there after four
_LIKELY = 16.0  # a rise of s by 16, four sigma, tells two poses apart
_APART_SIGMA = 6.0


def competing_pose(
    measured: Measurements, best: States, inliers: BoolArray, *, gate: float, score: float, chi2_per_dof: float
) -> Rigid | None:
    """Return another pose whose truncated score is not clearly worse, or None.

    Args:
        measured: all matches.
        best: the state found (B = 1).
        inliers: (N,) its inliers.
        gate: largest s of an inlier.
        score: the truncated score of the state found.
        chi2_per_dof: by which differences of scores are judged, where it exceeds 1.
    """
    pose = best.pose()
    members = np.flatnonzero(inliers)
    sample = members[np.unique(np.linspace(0, len(members) - 1, _SAMPLE).astype(np.intp))]
    few = measured.subset(sample)
    points = (few.rays * few.ranges).T
    here, seen = settle(few, States.of([pose], few), rounds=1)
    noise = max(1.0, chi2_per_dof if np.isfinite(chi2_per_dof) else 1.0)
    descent = Descent.start(few, States.of([mirrored(pose, points), *_orbits(pose, points)], few))
    for _ in range(_STEPS):
        descent.step(np.ones_like, _total)
    # A rival's score over all matches may be higher by _LIKELY, on a sample also by chance.
    worth = truncated_score(descent.seen.s, gate) < truncated_score(seen.s, gate) + (
        _LIKELY * noise + 4 * np.sqrt(4 * len(sample))
    )
    worth &= _apart(pose, descent.states, information_matrix(few, here)[0])
    if not worth.any():
        return None
    full = descent.states.subset(worth).seeing(measured)
    agreeing = measured.subset(inliers)
    H = information_matrix(agreeing, States.of([pose], agreeing))[0]
    others, scores = graduate(measured, full, narrow_scales(full, gate), gate)
    rivals = _apart(pose, others, H) & (scores < score + _LIKELY * noise)
    return others.pose(int(np.argmin(np.where(rivals, scores, np.inf)))) if rivals.any() else None


def mirrored(pose: Rigid, points: FloatArray) -> Rigid:
    """Return the pose that a flat scene, seen from afar, cannot be told from.

    Args:
        pose: camera_from_scanner.
        points: (N, 3), scanner frame, m; their best plane is meant.
    """
    centroid = points.mean(axis=0)
    normal = np.linalg.svd(points - centroid, full_matrices=False)[2][-1]
    seen = pose @ centroid
    sight = seen / max(float(np.linalg.norm(seen)), 1e-12)
    # Depths along the line of sight change sign, points of the plane stay where they are seen.
    R = (np.eye(3) - 2 * np.outer(sight, sight)) @ pose.rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
    return Rigid(R, seen - R @ centroid)


def _orbits(pose: Rigid, points: FloatArray) -> list[Rigid]:
    centroid = points.mean(axis=0)
    seen = pose @ centroid
    across = np.linalg.svd(seen[None])[2][1:]  # two axes across the line of sight
    orbits = []
    for k in range(_ORBITS):
        angle = 2 * np.pi * k / _ORBITS
        turn = rotation_from_rotvec((np.cos(angle) * across[0] + np.sin(angle) * across[1]) * _ORBIT_RAD)
        orbits.append(Rigid(turn @ pose.rotation, seen - turn @ pose.rotation @ centroid))
    return orbits


def _apart(pose: Rigid, states: States, H: FloatArray) -> BoolArray:
    relative = states.rotations @ pose.rotation.T
    # sin of the angle is enough here: what is far by it is far
    w = 0.5 * np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    step = np.concatenate([w, states.centres - pose.centre], axis=1)
    far = np.einsum("bi,ij,bj->b", step, H, step) > _APART_SIGMA**2
    return np.asarray(far | (np.trace(relative, axis1=1, axis2=2) < 1))


def _total(s: FloatArray) -> FloatArray:
    return np.asarray(s.sum(axis=-1))
