"""Acceptance of a pose on match statistics alone, with reasons.

A pose is accepted with evidence `statistics` if it has enough inliers, these are a large enough share of the matches,
the residuals agree with the noise, and no second pose explains the matches. Further rules cover cases that meet these
by default: agreement by chance, duplicated matches, a pose that the matches do not determine or that hinges on a single
match, and a camera that would see the scene from behind. `AcceptanceOptions` holds every threshold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import hypot, lgamma, log, log10

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, median
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, count_picks
from ladarreg_core.pose.estimators.bundle import UNSEEN, Evaluation
from ladarreg_core.pose.estimators.covariance import MIN_EIGENVALUE, guarded_inverse
from ladarreg_core.results.verdict_words import is_determined

_PLANE_SAMPLES = 80  # of three points each: the chance (1 - .7^3)^80 of missing a plane of 70 % is negligible
_HASH_WEIGHTS = np.sqrt([2.0, 3.0, 5.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceOptions:
    """Thresholds of acceptance on match statistics."""

    least_surplus: int = 6
    """Minimum number of independent inliers, of which a line counts two, beyond those that the unknowns need: three for
    a pose, and one for every two intrinsics."""
    least_share: float = 0.5
    """Minimum share of the matches that are inliers."""
    most_chi2_per_dof: float = 3.0
    """Maximum chi^2/dof of the inliers."""
    most_log10_chance: float = -3.0
    """Maximum log10 of the expected number of poses with as many inliers among random matches."""
    most_angle_rad: float = float(np.deg2rad(2.0))
    """Maximum standard deviation of the camera orientation, rad."""
    most_position_of_range: float = 0.1
    """Maximum standard deviation of the camera position, as a share of the matches' median range."""
    least_aspect: float = 0.02
    """Minimum width of the inliers in the photo over their length; below it they are collinear."""
    plane_tolerance: float = 0.05
    """Half of the maximum distance of a point on a plane from it, as a share of the points' middle extent."""
    plane_share: float = 0.7
    """Minimum share of the inliers on one plane for a pose that sees this plane from behind to be refused."""
    least_left_out_chance: float = 1e-3
    """Minimum probability that the largest leave-one-out error is as large as it is, over all matches."""
    critical_leverage: float = 0.9
    """Minimum leverage of a match for its removal to be tested."""
    most_growth: float = 6.0
    """Maximum growth of the standard deviation of position or orientation when one match is removed."""
    second_pose_margin: float = 16.0
    """A second pose competes if its -2 log likelihood, over chi^2/dof, exceeds the first one's by less than this."""
    second_pose_sigmas: float = 6.0
    """Minimum distance of a second pose from the first, in standard deviations; closer poses count as the same."""
    rival_share: float = 0.5
    """Outliers that agree on another pose compete if they are at least this share of the inliers."""
    least_rivals: int = 5
    """Minimum number of outliers that compete by agreeing on another pose."""
    planar_relief: float = 0.3
    """Maximum relief, smallest over middle extent, of points that count as planar and may have a mirrored pose."""
    many_inliers: int = 40
    """Number of inliers from which, unless they are planar, the quick search for a second pose is left out."""
    least_return_share: float = 0.25
    """Minimum share of the nearest starting poses that return to the pose."""

    def least_inliers(self, unknowns: int = 6) -> int:
        """Return the minimum number of independent inliers for so many unknowns, those of the pose included."""
        return -(-unknowns // 2) + self.least_surplus


DEFAULT_ACCEPTANCE = AcceptanceOptions()
"""The default thresholds."""


def decide_acceptance(
    *,
    pose: Rigid,
    matches: Matches,
    inliers: BoolArray,
    chi2_per_dof: float,
    covariance: FloatArray,
    log10_chance: float,
    unknowns: int = 6,
    second_pose: Rigid | None = None,
    critical_match: str | None = None,
    inconsistent_match: str | None = None,
    second_pose_sought: bool = True,
    stated_covariance: FloatArray | None = None,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> tuple[bool, tuple[str, ...]]:
    """Return whether a pose is accepted on match statistics, and the reasons.

    Args:
        pose: camera_from_scanner.
        matches: all matches.
        inliers: (M,) bool.
        chi2_per_dof: of the inliers.
        covariance: (6, 6) of (w, c).
        log10_chance: `log10_false_alarms` of the inliers.
        unknowns: number of fitted parameters.
        second_pose: another pose that explains the matches as well; None if none was found.
        critical_match: the pick without which the other matches barely determine the pose; None if there is none.
        inconsistent_match: the pick that the pose of the other matches misses by more than chance allows; None if there
            is none.
        second_pose_sought: whether a second pose was sought; the reasons then state that there is none.
        stated_covariance: (6, 6) to be stated in the reasons, including what is not known of the camera; None:
            `covariance`.
        options: the thresholds.
    """
    points, uv, picked = matches.points[inliers], matches.uv[inliers], count_picks(matches, inliers)
    # a line end known only across the line is an inlier more easily, so it does not count towards the share
    share = np.count_nonzero(inliers & ~matches.across) / len(matches)
    against = []
    missing = options.least_inliers(unknowns) - count_independent(matches, inliers)
    if missing > 0:
        against.append(f"too few matches agree for matches alone to decide: {more_matches(missing)}")
    if share < options.least_share:
        against.append("only {} of {} matches agree: correct or disable the others".format(*picked))
    if not np.isfinite(chi2_per_dof):
        against.append("there are too few inliers to check their residuals; add or correct matches")
    elif chi2_per_dof > options.most_chi2_per_dof:
        against.append(
            f"the residuals exceed the stated noise (chi^2/dof {chi2_per_dof:.1f}); check the matches with the largest "
            "residuals first, then the focal length and the lens distortion, or state larger noise"
        )
    if log10_chance > options.most_log10_chance:
        against.append(
            "with noise this large, random matches would give as many inliers; state smaller noise or add matches"
        )
    angle = float(np.sqrt(np.trace(covariance[:3, :3])))
    position = float(np.sqrt(np.trace(covariance[3:, 3:])))
    reach = median(matches.ranges)
    if not (angle <= options.most_angle_rad and position <= options.most_position_of_range * reach):
        known = f"(1 sigma: {format_length(position)}, {np.degrees(angle):.2g} deg)"
        how = (
            f"barely determine the pose {known}"
            if is_determined(angle, position, matches.ranges)
            else "do not determine the pose"
        )
        against.append(f"the matches {how}; spread them over the photo and over near and far surfaces")
    if _collinear(uv, options):
        against.append("the inliers are collinear in the photo; add matches off that line")
    if _sees_plane_from_behind(pose, points, options):
        against.append(
            "the camera would see the matches' plane from behind; check whether the photo or the scan is mirrored"
        )
    if critical_match is not None:
        against.append(
            f"the pose hinges on match {critical_match}: without it the other matches barely determine the pose; "
            "check it, or add matches near it"
        )
    if inconsistent_match is not None:
        against.append(
            f"the other matches agree on a pose that misses match {inconsistent_match} by more than their scatter "
            "explains; check it, or add matches near it"
        )
    if second_pose is not None:
        against.append(
            f"a second pose, {format_length(pose.distance_to(second_pose))} and "
            f"{np.degrees(pose.angle_to(second_pose)):.1f} deg away, explains the matches as well; add matches off "
            "their common plane"
        )
    if against:
        return False, tuple(against)
    if stated_covariance is not None:
        angle, position = (float(np.sqrt(np.trace(C))) for C in (stated_covariance[:3, :3], stated_covariance[3:, 3:]))
    return True, (
        "{} of {} matches agree ".format(*picked) + f"(chi^2/dof {chi2_per_dof:.2f})",
        f"uncertainty (1 sigma): position {format_length(position)}, orientation {np.degrees(angle):.2g} deg",
        *(("no second pose explains the matches",) if second_pose_sought else ()),
    )


def _collinear(uv: FloatArray, options: AcceptanceOptions) -> bool:
    """Return whether pixels (N, 2) lie on one line, about which only their noise would fix the camera's rotation."""
    if len(uv) < 3:
        return False
    centred = uv - uv.mean(axis=0)
    (a, b), (_, c) = (centred.T @ centred).tolist()
    # eigenvalues of the scatter, the smaller from the determinant, which cancels less
    larger = (a + c) / 2 + hypot((a - c) / 2, b)
    return bool(larger <= 0 or (a * c - b * b) / larger <= options.least_aspect**2 * larger)


def _sees_plane_from_behind(pose: Rigid, points: FloatArray, options: AcceptanceOptions) -> bool:
    """Return whether most points (N, 3) lie on a plane between scanner and camera, as for a mirrored photo.

    A few points off the plane do not rule this out: near the image centre they project alike from either side.
    """
    if len(points) < 3:
        return False
    plane = _common_plane(points, options)
    if plane is None:
        return False
    centroid, normal = plane
    return bool((centroid @ normal) * ((centroid - pose.centre) @ normal) < 0)


def _common_plane(points: FloatArray, options: AcceptanceOptions) -> tuple[FloatArray, FloatArray] | None:
    """Return a point and the normal of the plane that contains most of the points (N, 3), or None."""
    least = max(3.0, options.plane_share * len(points))
    a, b, c = points[_triples(len(points))]
    (x, y, z), (u, v, w) = (b - a).T, (c - a).T
    normals = np.stack([y * w - z * v, z * u - x * w, x * v - y * u])  # (3, planes)
    length = np.sqrt((normals * normals).sum(axis=0))
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    centred = points - points.mean(axis=0)
    width = np.sqrt(max(float(np.linalg.eigvalsh(centred.T @ centred)[1]) / len(points), 0.0))
    within = np.where(length > 0, 2 * options.plane_tolerance * width, -1.0)
    through = (a.T * normals).sum(axis=0)
    for part in (points[: len(points) // 2], points):  # half of the points mostly rule out every plane
        on_plane = np.abs(part @ normals - through) <= within
        counts = np.count_nonzero(on_plane, axis=0)
        if counts.max() + len(points) - len(part) < least:
            return None
    members = points[on_plane[:, int(np.argmax(counts))]]
    centroid = members.mean(axis=0)
    centred = members - centroid
    return centroid, np.linalg.eigh(centred.T @ centred)[1][:, 0]


@lru_cache(maxsize=64)
def _triples(count: int) -> IntArray:
    """Return the indices (3, planes) of the points through which planes are tried."""
    return np.random.default_rng(0).integers(0, count, (3, _PLANE_SAMPLES))


def more_matches(missing: int) -> str:
    """Return what to draw where so many independent points are missing; a line counts two."""
    lines = -(-missing // 2)
    return f"draw {_counted(lines, 'more line')}, or {_counted(missing, 'more point')}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def count_independent(matches: Matches, inliers: BoolArray) -> int:
    """Return the number of independent points among the inliers (M,): a line counts two, however often it is sampled.

    A line end known only across the line counts half, and duplicates are no evidence.
    """
    halves = int(np.count_nonzero(matches.across[inliers]))
    distinct = count_distinct(matches.points[inliers], matches.uv[inliers]) - (halves + 1) // 2
    _, pick = matches.numbered_picks()
    of_pick = np.bincount(pick[inliers])
    return min(distinct, int(np.minimum(of_pick, 2).sum()))


def count_distinct(points: FloatArray, uv: FloatArray) -> int:
    """Return the number of matches that differ on both sides, (N, 3) and (N, 2): duplicates are no evidence."""
    # hash each row to one number, which is faster to sort; collisions are practically impossible
    return min(_count_different(points @ _HASH_WEIGHTS), _count_different(uv @ _HASH_WEIGHTS[:2]))


def _count_different(numbers: FloatArray) -> int:
    """Return how many of the finite numbers (N,) differ."""
    ordered = np.sort(numbers)
    return min(len(numbers), 1 + int(np.count_nonzero(ordered[1:] != ordered[:-1])))


def log10_false_alarms(
    at: Evaluation, matches: Matches, inliers: BoolArray, camera: CameraModel, *, gate: float
) -> float:
    """Return log10 of the expected number of poses with as many inliers if all matches were random.

    Args:
        at: all matches at the pose.
        matches: the same matches.
        inliers: (M,) bool.
        camera: intrinsics.
        gate: largest cost s of an inlier.

    Source: Moulon, Monasse and Marlet, Adaptive structure from motion with a contrario model estimation (2012).
    """
    n, k = len(matches), int(np.count_nonzero(inliers))
    if k <= 3:
        return float(log10(max(n, 1)))
    measured = at.measured
    # det(M - M j j^T M / h) = det M / (sigma_r^2 h)
    determinant = measured.information[0] * measured.information[1] - measured.cross_information[0] ** 2
    determinant = determinant * measured.range_information / at.lin.h[0]
    low, high = matches.uv.min(axis=0), matches.uv.max(axis=0)
    full = inliers & (matches.dimensions == 2)
    if not full.any():
        return float(log10(max(n, 1)))
    gate_area = np.pi * gate * camera.focal_px**2 / np.sqrt(median(determinant[full]))
    radius = np.sqrt(gate_area / np.pi)
    patch = float(np.prod(np.minimum(high - low + 2 * radius, np.maximum(camera.size, high - low))))
    p = float(min(1.0, gate_area / max(patch, 1e-9)))
    # a point-to-line distance agrees by chance as often as one of a point's two coordinates
    coordinates = float(matches.dimensions[inliers].sum()) / 2 - 3
    return log10(n - 3) + _log10_choose(n, k) + _log10_choose(k, 3) + coordinates * log10(max(p, 1e-12))


def find_critical_match(
    at: Evaluation,
    matches: Matches,
    inliers: BoolArray,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> str | None:
    """Return the pick on which the pose hinges, or None: a pick that nothing else checks has no residual to show.

    Without pick k, whose part of the information H is A, the covariance is (H - A)^-1.

    Args:
        at: all matches at the pose.
        matches: the same matches.
        inliers: (M,) bool.
        options: the thresholds.

    Source: Cook and Weisberg, Residuals and influence in regression (1982), for deletion.
    """
    J, K = parts_of_information(at, inliers)
    H, unit, inverse = information_of(J, K)
    names, pick = matches.numbered_picks()
    # a standard deviation grows noticeably only if a pick provides nearly all the information in some direction
    heavy = np.flatnonzero(_leverages(J, K, unit, inverse, pick) > options.critical_leverage)
    if not len(heavy):
        return None
    own = [(K[..., pick == k].reshape(6, -1), J[..., pick == k].reshape(6, -1)) for k in heavy]
    parts = np.stack([a @ b.T for a, b in own])
    values, vectors = np.linalg.eigh((H - parts) * np.outer(unit, unit))
    variance = np.einsum("kab,kb->ka", vectors**2, 1 / np.maximum(values, MIN_EIGENVALUE)) * unit**2
    angle, position = np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(variance[:, 3:].sum(axis=1))
    most_position_m = options.most_position_of_range * median(matches.ranges)
    beyond = np.maximum(angle / options.most_angle_rad, position / most_position_m)
    with_all = np.diag(inverse) * unit**2
    grown = np.maximum(angle / np.sqrt(with_all[:3].sum()), position / np.sqrt(with_all[3:].sum()))
    worst = int(np.argmax(np.maximum(beyond, grown / options.most_growth)))
    return str(names[heavy[worst]]) if max(beyond[worst], grown[worst] / options.most_growth) > 1 else None


def find_inconsistent_match(
    at: Evaluation,
    matches: Matches,
    inliers: BoolArray,
    *,
    unknowns: int = 6,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> str | None:
    """Return the pick that the pose fitted to the other inliers misses by more than chance allows, or None.

    The squared error of pick k beside the pose of the others, in units of its own variance, is s_k + g (H - A)^-1 g
    with g its part of the gradient and A its part of the information H. Its ratio to what the others leave has Fisher's
    F distribution, however large the noise is; the bound on the largest of all is the sum of their probabilities.

    Args:
        at: all matches at the pose.
        matches: the same matches.
        inliers: (M,) bool.
        unknowns: number of fitted parameters.
        options: the thresholds.

    Source: Cook and Weisberg, Residuals and influence in regression (1982), externally studentised residuals;
    Bonferroni (1936).
    """
    from scipy.special import fdtrc, fdtri

    counts = inliers & (at.seen.s[0] < UNSEEN)
    names, pick = matches.numbered_picks()
    s = np.bincount(pick, counts * at.seen.s[0], len(names))
    own_dof = np.bincount(pick, counts * matches.dimensions, len(names))
    dof = own_dof.sum() - unknowns
    picked, most = np.count_nonzero(own_dof), own_dof.max(initial=0)
    if dof <= most or not s.sum() > 0:
        return None
    # what the largest number of coordinates of a pick could exceed by chance is exceeded by few, if by any
    ratio = fdtri(most, dof - most, 1 - options.least_left_out_chance / picked)
    least = s.sum() / (1 + (dof - most) / (most * ratio)) / most  # for any smaller number it is smaller
    J, K = parts_of_information(at, inliers)
    H, unit, inverse = information_of(J, K)
    spare = np.maximum(1 - _leverages(J, K, unit, inverse, pick), 1e-3)
    e = at.seen.e[0] - at.lin.j[0] * at.seen.range_error[0]  # at the measured range
    chances: dict[str, float] = {}
    for k in np.flatnonzero((own_dof > 0) & (s / spare > least)):
        mine = pick == k
        A = K[..., mine].reshape(6, -1) @ J[..., mine].reshape(6, -1).T
        g = K[..., mine].reshape(6, -1) @ e[:, mine].ravel()
        rest = guarded_inverse((H - A) * np.outer(unit, unit)) * np.outer(unit, unit)
        left_out = min(float(s[k] + g @ rest @ g), float(s.sum()))
        others = (s.sum() - left_out) / (dof - own_dof[k])
        worse = np.inf if others <= 0 else left_out / own_dof[k] / others
        chances[names[k]] = picked * float(fdtrc(own_dof[k], dof - own_dof[k], worse))
    worst = min(chances, key=chances.__getitem__, default=None)
    return worst if worst is not None and chances[worst] < options.least_left_out_chance else None


def parts_of_information(at: Evaluation, inliers: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return J (6, 2, N) and K = J W (6, 2, N) of the inliers, with the ranges marginalised; K is 0 of the others."""
    measured, lin = at.measured, at.lin
    counts = inliers & (at.seen.s[0] < UNSEEN)
    share = lin.m[0] / lin.h[0]
    diagonal = counts * (measured.information - lin.m[0] * share)
    cross = counts * (measured.cross_information - lin.m[0, :1] * share[1:])
    J = lin.j_pose[0]
    K = diagonal * J
    K += cross * J[:, ::-1]
    return J, K


def information_of(J: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return H (6, 6), the units (6,) in which its diagonal is 1, and its inverse in them."""
    H = K.reshape(6, -1) @ J.reshape(6, -1).T
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return H, unit, guarded_inverse(H * np.outer(unit, unit))


def _leverages(J: FloatArray, K: FloatArray, unit: FloatArray, inverse: FloatArray, pick: IntArray) -> FloatArray:
    """Return the leverage of each pick."""
    scaled = (inverse * np.outer(unit, unit)) @ K.reshape(6, -1)
    scaled *= J.reshape(6, -1)
    of_match = scaled.sum(axis=0).reshape(2, -1).sum(axis=0)
    return np.asarray(np.bincount(pick, of_match))


def _log10_choose(n: int, k: int) -> float:
    return (lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)) / log(10)
