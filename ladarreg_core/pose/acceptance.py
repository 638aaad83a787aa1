"""Whether the matches alone are evidence enough, in sentences.

The rule is that of `statistics`: at least 12 inliers, half of the matches, chi^2/dof <= 3 and no second minimum. Four
further questions keep a pose from being called certain where that rule is satisfied by default: whether the agreement
could be chance, whether copies of one match were counted, whether the pose is determined at all, and whether the
camera sees surfaces from the side that the scanner saw.
"""

from __future__ import annotations

from math import lgamma, log, log10

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, linearise, residuals
from ladarreg_core.pose.covariance import LEAST_EIGENVALUE, guarded_inverse

LEAST_INLIERS = 12
LEAST_SHARE = 0.5
MOST_CHI2_PER_DOF = 3.0
MOST_ANGLE_RAD = np.deg2rad(2.0)
MOST_POSITION_OF_RANGE = 0.1
_MOST_LOG10_CHANCE = -3.0
_FLAT = 0.05
_MOSTLY = 0.7
_PLANES = 80  # of three points each: (1 - .7^3)^80 misses a plane of 70 % never
_LEAST_WIDTH = 0.02  # of the matches in the photo, across over along: below it they lie on one line
_KEY = np.sqrt([2.0, 3.0, 5.0])
_LEAST_LEVERAGE = 0.9
_MOST_GROWTH = 6.0  # of a standard deviation without the pick: nothing else sees a slip of it


def judge(
    *,
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    chi2_per_dof: float,
    covariance: FloatArray,
    log10_chance: float,
    rival: Rigid | None = None,
    held_by: str | None = None,
) -> tuple[bool, tuple[str, ...]]:
    """Return whether the pose is accepted by `statistics`, and why or why not.

    Args:
        pose: camera_from_scanner.
        matches: all matches.
        inliers: (M,) those that agree.
        chi2_per_dof: over the inliers.
        covariance: (6, 6) of (w, c).
        log10_chance: `chance_agreement` of the inliers.
        rival: another pose that explains them as well; None where none was found.
        held_by: the pick without which the others hardly determine the pose; None where there is none.
    """
    # an end of a line that is known across it only counts as half a match
    halves = int(np.count_nonzero(matches.dimensions[inliers] == 1))
    agree, count = distinct(matches.points[inliers], matches.uv[inliers]) - (halves + 1) // 2, len(matches)
    # what is known across its line agrees more easily, and says nothing of where along it
    share = np.count_nonzero(inliers & (matches.dimensions == 2)) / count
    against = []
    if agree < LEAST_INLIERS:
        against.append(
            f"only {agree} different matches agree with the pose and {LEAST_INLIERS} are needed; add or correct matches"
        )
    if share < LEAST_SHARE:
        against.append(
            f"only {share:.0%} of the {count} matches agree with the pose and {LEAST_SHARE:.0%} are needed; "
            "correct or remove the others"
        )
    if not chi2_per_dof <= MOST_CHI2_PER_DOF:
        against.append(
            f"the residuals are larger than the stated noise explains (chi^2/dof {chi2_per_dof:.1f}, at most "
            f"{MOST_CHI2_PER_DOF:g}); check the focal length and the lens, or state a larger noise"
        )
    if log10_chance > _MOST_LOG10_CHANCE:
        against.append(
            "as many matches would agree by chance at so large a noise; state a smaller noise or add matches"
        )
    angle = float(np.sqrt(np.trace(covariance[:3, :3])))
    position = float(np.sqrt(np.trace(covariance[3:, 3:])))
    reach = float(np.median(matches.ranges))
    if not (angle <= MOST_ANGLE_RAD and position <= MOST_POSITION_OF_RANGE * reach):
        against.append(
            f"the matches hardly determine the pose ({_length(position)} and {np.degrees(angle):.2g} deg, 1 sigma); "
            "spread them over the picture and over near and far"
        )
    if _on_one_line(matches.uv[inliers]):
        against.append("the matches lie on one line of the photo; add matches beside it")
    if _from_behind(pose, matches.points[inliers]):
        against.append(
            "the camera would see the matches' plane from behind; check that the photo and the scan are not mirrored"
        )
    if held_by is not None:
        against.append(
            f"match {held_by} alone holds the pose, which the others would hardly determine; check it, or add matches "
            "near it"
        )
    if rival is not None:
        against.append(
            f"a second pose, {_length(pose.distance_to(rival))} and {np.degrees(pose.angle_to(rival)):.1f} deg away, "
            "explains the matches as well; add matches off their plane"
        )
    if against:
        return False, tuple(against)
    return True, (
        f"{np.count_nonzero(inliers)} of {count} matches agree with the pose (chi^2/dof {chi2_per_dof:.2f})",
        f"the camera is known to {_length(position)} and {np.degrees(angle):.2g} deg (1 sigma)",
        "no second pose explains the matches",
    )


def _on_one_line(uv: FloatArray) -> bool:
    """Return whether pixels (N, 2) leave the camera free to turn about a line: their noise then passes for a hold."""
    if len(uv) < 3:
        return False
    centred = uv - uv.mean(axis=0)
    squared = np.linalg.eigvalsh(centred.T @ centred)
    return bool(squared[0] <= _LEAST_WIDTH**2 * squared[1])


def _from_behind(pose: Rigid, points: FloatArray) -> bool:
    """Return whether most of the points (N, 3) lie on a plane between scanner and camera: a mirrored picture fits so.

    A few off it prove nothing: those near the picture's middle are seen there from either side.
    """
    if len(points) < 3:
        return False
    plane = _common_plane(points)
    if plane is None:
        return False
    centroid, normal = plane
    return bool((centroid @ normal) * ((centroid - pose.centre) @ normal) < 0)


def _common_plane(points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return a point and the normal of the plane that most of the points (N, 3) lie on; None where there is none."""
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(0, len(points), (3, _PLANES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    off = np.where(length > 0, np.abs(points @ normals.T - (a * normals).sum(axis=1)).T, np.inf)
    width = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T, bias=True))[1], 0))
    on_plane = off <= 2 * _FLAT * width
    best = int(np.argmax(np.count_nonzero(on_plane, axis=1)))
    members = points[on_plane[best]]
    if len(members) < max(3, _MOSTLY * len(points)):
        return None
    centroid = members.mean(axis=0)
    centred = members - centroid
    return centroid, np.linalg.eigh(centred.T @ centred)[1][:, 0]


def distinct(points: FloatArray, uv: FloatArray) -> int:
    """Return how many matches differ from each other on both sides, (N, 3) and (N, 2): copies are no evidence."""
    # One number stands for a row: different rows share it by accident only, and sorting numbers is quick.
    return min(len(np.unique(points @ _KEY)), len(np.unique(uv @ _KEY[:2])))


def chance_agreement(
    measured: Measurements, matches: Matches, state: States, inliers: BoolArray, camera: Camera, *, gate: float
) -> float:
    """Return log10 of the number of poses that as many matches would agree with, were all of them random.

    Args:
        measured: all matches.
        matches: the same.
        state: the pose (B = 1).
        inliers: (M,) those that agree.
        camera: intrinsics.
        gate: largest s of an inlier.

    Source: Moulon, Monasse and Marlet, Adaptive structure from motion with a contrario model estimation (2012).
    """
    n, k = len(matches), int(np.count_nonzero(inliers))
    if k <= 3:
        return float(log10(max(n, 1)))
    lin = linearise(measured, state, residuals(measured, state))
    # det(M - M j j^T M / h) = det M / (sigma_r^2 h)
    determinant = measured.information.prod(axis=0) - measured.cross_information[0] ** 2
    determinant = determinant * measured.range_information / lin.h[0]
    low, high = matches.uv.min(axis=0), matches.uv.max(axis=0)
    full = inliers & (matches.dimensions == 2)
    if not full.any():
        return float(log10(max(n, 1)))
    gate_area = np.pi * gate * camera.fx * camera.fy / np.sqrt(np.median(determinant[full]))
    radius = np.sqrt(gate_area / np.pi)
    patch = float(np.prod(np.minimum(high - low + 2 * radius, np.maximum(camera.size, high - low))))
    p = float(min(1.0, gate_area / max(patch, 1e-9)))
    # a point-to-line distance is met by chance as often as one of the point's two coordinates
    coordinates = float(matches.dimensions[inliers].sum()) / 2 - 3
    return log10(n - 3) + _log10_choose(n, k) + _log10_choose(k, 3) + coordinates * log10(max(p, 1e-12))


def single_hold(
    measured: Measurements,
    matches: Matches,
    state: States,
    inliers: BoolArray,
    *,
    most_angle_rad: float,
    most_position_m: float,
) -> str | None:
    """Return the pick without which the others determine the pose no better than this, or None.

    Args:
        measured: all matches.
        matches: the same.
        state: the pose (B = 1).
        inliers: (M,) those that agree.
        most_angle_rad: largest standard deviation of the rotation that is still a pose.
        most_position_m: of the camera centre.
    """
    seen = residuals(measured, state)
    lin = linearise(measured, state, seen)
    counts = inliers & (seen.s[0] < UNSEEN)
    share = lin.m[0] / lin.h[0]
    diagonal = measured.information - lin.m[0] * share
    cross = measured.cross_information - lin.m[0, :1] * share[1:]
    J = lin.j_pose[0]  # (6, 2, N)
    each = np.einsum("aen,ben->nab", diagonal * J + cross * J[:, ::-1], J) * counts[:, None, None]
    names, pick = np.unique(np.asarray(matches.pick_ids), return_inverse=True)
    parts = np.zeros((len(names), 6, 6))
    np.add.at(parts, pick, each)
    H = parts.sum(axis=0)
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = guarded_inverse(H * np.outer(unit, unit))
    # a standard deviation grows only where a pick has nearly all the information of some direction
    leverage = np.einsum("kab,ab->k", parts * np.outer(unit, unit), inverse)
    heavy = np.flatnonzero(leverage > _LEAST_LEVERAGE)
    if not len(heavy):
        return None
    values, vectors = np.linalg.eigh((H - parts[heavy]) * np.outer(unit, unit))
    variance = np.einsum("kab,kb->ka", vectors**2, 1 / np.maximum(values, LEAST_EIGENVALUE)) * unit**2
    angle, position = np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(variance[:, 3:].sum(axis=1))
    beyond = np.maximum(angle / most_angle_rad, position / most_position_m)
    with_all = np.diag(inverse) * unit**2
    grown = np.maximum(angle / np.sqrt(with_all[:3].sum()), position / np.sqrt(with_all[3:].sum()))
    worst = int(np.argmax(np.maximum(beyond, grown / _MOST_GROWTH)))
    return str(names[heavy[worst]]) if max(beyond[worst], grown[worst] / _MOST_GROWTH) > 1 else None


def _log10_choose(n: int, k: int) -> float:
    return (lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)) / log(10)


def _length(metres: float) -> str:
    return f"{metres * 1000:.1f} mm" if metres < 0.1 else f"{metres:.2f} m"
