"""Whether another pose explains the matches as well: the mirrored one of a plane, or any that nearby starts reach.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two-fold ambiguity.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.bundle import Descent, Measurements, States, information_matrix, rotations_from_rotvecs
from ladarreg_core.pose.gnc import graduate, narrow_scales, truncated_score

_ORBIT_RAD = np.deg2rad(20.0)
_ORBITS = 3
_SAMPLE = 20
_STEPS = 4  # starts that come home are there after three
_LIKELY = 16.0  # a rise of s by 16, four sigma, tells two poses apart
_APART_SIGMA = 6.0


def competing_pose(
    measured: Measurements, best: States, inliers: BoolArray, *, s: FloatArray, gate: float, chi2_per_dof: float
) -> Rigid | None:
    """Return another pose whose truncated score is not clearly worse, or None.

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
    descent = Descent.start(few, _starts(pose, (few.rays * few.ranges).T, few))
    for _ in range(_STEPS):
        descent.step(np.ones_like, _total)
    # A rival's score over all matches may be higher by _LIKELY, on a sample also by chance.
    worth = truncated_score(descent.seen.s, gate) < truncated_score(s[sample], gate) + (
        _LIKELY * noise + 4 * np.sqrt(4 * len(sample))
    )
    worth &= _apart(pose, descent.states, H * (len(sample) / len(members)))
    if not worth.any():
        return None
    full = descent.states.subset(worth).seeing(measured)
    others, scores = graduate(measured, full, narrow_scales(full, gate), gate)
    rivals = _apart(pose, others, H) & (scores < truncated_score(s, gate) + _LIKELY * noise)
    return others.pose(int(np.argmin(np.where(rivals, scores, np.inf)))) if rivals.any() else None


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


def _starts(pose: Rigid, points: FloatArray, few: Measurements) -> States:
    """Return the mirrored pose and some whose camera went round the points, which stay in its view."""
    flipped = mirrored(pose, points)
    centroid = points.mean(axis=0)
    x, y, z = seen = pose @ centroid
    across = np.array([z, 0.0, -x]) if abs(y) <= abs(z) else np.array([y, -x, 0.0])  # not along the line of sight
    across = across / max(float(np.linalg.norm(across)), 1e-12)
    other = np.cross(seen / max(float(np.linalg.norm(seen)), 1e-12), across)
    angles = 2 * np.pi * np.arange(_ORBITS) / _ORBITS
    turns = rotations_from_rotvecs(_ORBIT_RAD * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * other))
    R = np.concatenate([flipped.rotation[None], turns @ pose.rotation])
    centres = centroid - R.swapaxes(1, 2) @ seen
    return States(R, centres, np.tile(few.ranges, (len(R), 1)))


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
