"""Acceptance of a pose on match statistics alone, with reasons.

A pose is accepted with evidence `statistics` if it has at least 12 inliers, these are at least half of the matches,
chi^2/dof <= 3, and no second pose explains the matches. Further rules cover cases that meet these by default: agreement
by chance, duplicated matches, a pose that the matches do not determine or that hinges on a single match, and a camera
that would see the scene from behind.
"""

from __future__ import annotations

from math import lgamma, log, log10

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.formatting import format_length
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, linearise, residuals
from ladarreg_core.pose.covariance import LEAST_EIGENVALUE, guarded_inverse

LEAST_INLIERS = 12
"""Fewest distinct inliers."""
LEAST_SHARE = 0.5
"""Smallest share of the matches that must be inliers."""
MOST_CHI2_PER_DOF = 3.0
"""Largest chi^2/dof of the inliers."""
MOST_ANGLE_RAD = np.deg2rad(2.0)
"""Largest standard deviation of the camera orientation, rad."""
MOST_POSITION_OF_RANGE = 0.1
"""Largest standard deviation of the camera position, as a share of the matches' median range."""
_MOST_LOG10_FALSE_ALARMS = -3.0
_PLANE_TOLERANCE = 0.05  # distance from a plane, relative to the points' extent
_PLANE_SHARE = 0.7
_PLANE_SAMPLES = 80  # of three points each: the chance (1 - .7^3)^80 of missing a plane of 70 % is negligible
_LEAST_ASPECT = 0.02  # of the matches in the photo, width over length: below it they are collinear
_HASH_WEIGHTS = np.sqrt([2.0, 3.0, 5.0])
_LEAST_LEVERAGE = 0.9
_MOST_GROWTH = 6.0  # of a standard deviation when the pick is removed


def decide_acceptance(
    *,
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    chi2_per_dof: float,
    covariance: FloatArray,
    log10_chance: float,
    second_pose: Rigid | None = None,
    critical_match: str | None = None,
) -> tuple[bool, tuple[str, ...]]:
    """Return whether a pose is accepted on match statistics, and the reasons.

    Args:
        pose: camera_from_scanner.
        matches: all matches.
        inliers: (M,) bool.
        chi2_per_dof: of the inliers.
        covariance: (6, 6) of (w, c).
        log10_chance: `log10_false_alarms` of the inliers.
        second_pose: another pose that explains the matches as well; None if none was found.
        critical_match: the pick without which the other matches barely determine the pose; None if there is none.
    """
    # a line end known only across the line counts as half a match
    halves = int(np.count_nonzero(matches.dimensions[inliers] == 1))
    agree, count = count_distinct(matches.points[inliers], matches.uv[inliers]) - (halves + 1) // 2, len(matches)
    # a line end known only across the line is an inlier more easily, so it does not count towards the share
    share = np.count_nonzero(inliers & (matches.dimensions == 2)) / count
    against = []
    if agree < LEAST_INLIERS:
        against.append(f"only {agree} distinct inliers, {LEAST_INLIERS} are needed; add or correct matches")
    if share < LEAST_SHARE:
        against.append(
            f"only {share:.0%} of {count} matches are inliers, {LEAST_SHARE:.0%} are needed; "
            "correct or remove the outliers"
        )
    if not chi2_per_dof <= MOST_CHI2_PER_DOF:
        against.append(
            f"the residuals exceed the stated noise (chi^2/dof {chi2_per_dof:.1f}, at most {MOST_CHI2_PER_DOF:g}); "
            "check the focal length and lens distortion, or state larger noise"
        )
    if log10_chance > _MOST_LOG10_FALSE_ALARMS:
        against.append(
            "with noise this large, random matches would give as many inliers; state smaller noise or add matches"
        )
    angle = float(np.sqrt(np.trace(covariance[:3, :3])))
    position = float(np.sqrt(np.trace(covariance[3:, 3:])))
    reach = float(np.median(matches.ranges))
    if not (angle <= MOST_ANGLE_RAD and position <= MOST_POSITION_OF_RANGE * reach):
        against.append(
            f"the matches barely determine the pose (1 sigma: {format_length(position)}, "
            f"{np.degrees(angle):.2g} deg); spread them over the photo and over near and far surfaces"
        )
    if _collinear(matches.uv[inliers]):
        against.append("the inliers are collinear in the photo; add matches off that line")
    if _sees_plane_from_behind(pose, matches.points[inliers]):
        against.append(
            "the camera would see the matches' plane from behind; check whether the photo or the scan is mirrored"
        )
    if critical_match is not None:
        against.append(
            f"the pose hinges on match {critical_match}: without it the other matches barely determine the pose; "
            "check it, or add matches near it"
        )
    if second_pose is not None:
        against.append(
            f"a second pose, {format_length(pose.distance_to(second_pose))} and "
            f"{np.degrees(pose.angle_to(second_pose)):.1f} deg away, explains the matches as well; add matches off "
            "their common plane"
        )
    if against:
        return False, tuple(against)
    return True, (
        f"{np.count_nonzero(inliers)} of {count} inliers (chi^2/dof {chi2_per_dof:.2f})",
        f"uncertainty (1 sigma): position {format_length(position)}, orientation {np.degrees(angle):.2g} deg",
        "no second pose explains the matches",
    )


def _collinear(uv: FloatArray) -> bool:
    """Return whether pixels (N, 2) lie on one line, about which only their noise would fix the camera's rotation."""
    if len(uv) < 3:
        return False
    centred = uv - uv.mean(axis=0)
    squared = np.linalg.eigvalsh(centred.T @ centred)
    return bool(squared[0] <= _LEAST_ASPECT**2 * squared[1])


def _sees_plane_from_behind(pose: Rigid, points: FloatArray) -> bool:
    """Return whether most points (N, 3) lie on a plane between scanner and camera, as for a mirrored photo.

    A few points off the plane do not rule this out: near the image centre they project alike from either side.
    """
    if len(points) < 3:
        return False
    plane = _common_plane(points)
    if plane is None:
        return False
    centroid, normal = plane
    return bool((centroid @ normal) * ((centroid - pose.centre) @ normal) < 0)


def _common_plane(points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return a point and the normal of the plane that contains most of the points (N, 3), or None."""
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(0, len(points), (3, _PLANE_SAMPLES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    off = np.where(length > 0, np.abs(points @ normals.T - (a * normals).sum(axis=1)).T, np.inf)
    width = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T, bias=True))[1], 0))
    on_plane = off <= 2 * _PLANE_TOLERANCE * width
    best = int(np.argmax(np.count_nonzero(on_plane, axis=1)))
    members = points[on_plane[best]]
    if len(members) < max(3, _PLANE_SHARE * len(points)):
        return None
    centroid = members.mean(axis=0)
    centred = members - centroid
    return centroid, np.linalg.eigh(centred.T @ centred)[1][:, 0]


def count_distinct(points: FloatArray, uv: FloatArray) -> int:
    """Return the number of matches that differ on both sides, (N, 3) and (N, 2): duplicates are no evidence."""
    # hash each row to one number, which is faster to sort; collisions are practically impossible
    return min(len(np.unique(points @ _HASH_WEIGHTS)), len(np.unique(uv @ _HASH_WEIGHTS[:2])))


def log10_false_alarms(
    measured: Measurements, matches: Matches, state: States, inliers: BoolArray, camera: Camera, *, gate: float
) -> float:
    """Return log10 of the expected number of poses with as many inliers if all matches were random.

    Args:
        measured: all matches.
        matches: the same matches.
        state: the pose (B = 1).
        inliers: (M,) bool.
        camera: intrinsics.
        gate: largest cost s of an inlier.

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
    # a point-to-line distance agrees by chance as often as one of a point's two coordinates
    coordinates = float(matches.dimensions[inliers].sum()) / 2 - 3
    return log10(n - 3) + _log10_choose(n, k) + _log10_choose(k, 3) + coordinates * log10(max(p, 1e-12))


def find_critical_match(
    measured: Measurements,
    matches: Matches,
    state: States,
    inliers: BoolArray,
    *,
    most_angle_rad: float,
    most_position_m: float,
) -> str | None:
    """Return the pick on which the pose hinges, or None: a pick that nothing else checks has no residual to show.

    Without pick k, whose part of the information H is A, the covariance is (H - A)^-1.

    Args:
        measured: all matches.
        matches: the same matches.
        state: the pose (B = 1).
        inliers: (M,) bool.
        most_angle_rad: largest acceptable standard deviation of the rotation without the pick, rad.
        most_position_m: largest acceptable standard deviation of the camera centre without the pick, m.

    Source: Cook and Weisberg, Residuals and influence in regression (1982), for deletion.
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
    # a standard deviation grows noticeably only if a pick provides nearly all the information in some direction
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
