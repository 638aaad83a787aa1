"""Basin of attraction of a pose and its ambiguity, by refinement from many starting poses.

All starting poses are refined at once on a sample of the matches, with a robust cost whose initial scale fits the error
of each start; starts that converge are merged. Only final poses that explain the sample are then refined on all
matches, together with candidates that no start near the pose may reach: the mirrored pose of a plane, and the pose on
which the outliers agree.

Source: the methods named in `gnc`, `ambiguity` and `ransac`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, AcceptanceOptions
from ladarreg_core.pose.ambiguity import (
    count_rivals,
    is_planar,
    least_support,
    likelihood_scores,
    mirrored,
    orbiting_poses,
    pose_differences,
    pose_of_outliers,
    poses_towards_mirrored,
    refine_generalised,
)
from ladarreg_core.pose.estimators.bundle import (
    States,
    adjust_ranges,
    information_matrix,
    residuals,
    rotations_from_rotvecs,
)
from ladarreg_core.pose.estimators.covariance import MIN_EIGENVALUE, guarded_inverse
from ladarreg_core.pose.estimators.gnc import (
    graduate,
    graduate_merging,
    group_by_leader,
    narrow_scales,
    near_pairs,
)
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.options import PoseOptions
from ladarreg_core.pose.preconditions import MIN_MATCHES
from ladarreg_core.results.registration import PoseResult

BasinVerdict = Literal["unique", "ambiguous", "failed"]

RETURN_SHARE = 0.9
"""A level belongs to the basin if at least this share of its starts returns to the pose."""
_LEVELS_DEG = (5.0, 10.0, 20.0, 40.0)
_LEVELS_OF_DISTANCE = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # .25, .5, 1 and 2 m for matches at 4 m
_MIN_STARTS, _MAX_STARTS = 8, 4096
_SAMPLE, _MAX_SAMPLE = 40, 160  # inliers, and all matches
_SAME_RAD, _SAME_OF_DISTANCE = np.deg2rad(4.0), 0.1  # bounds of a cluster, however weak the matches
_MAX_REFINED = 8
_LAST_STEPS = 8  # on all matches, after those on a sample


@dataclass(frozen=True, slots=True)
class BasinLevel:
    """Starting poses at equal distance from the pose, in random directions."""

    angle_rad: float
    """Rotation from the pose, rad."""
    distance_m: float
    """Distance from the pose, m."""
    starts: int
    """Number of starts."""
    returned: int
    """Number of starts that returned to the pose."""

    @property
    def share(self) -> float:
        """Share of the starts that returned."""
        return self.returned / self.starts


@dataclass(frozen=True, slots=True, eq=False)
class PoseCluster:
    """A pose at which refinements end, or one on the way to the mirrored pose of a plane."""

    pose: Rigid
    """camera_from_scanner."""
    score: float
    """-2 log likelihood over all matches up to a constant, see `likelihood_scores`; lower is better."""
    inliers: int
    """Number of inliers."""
    starts: int
    """Number of perturbed starts that ended there; 0 if only a candidate did."""


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """Basin of attraction of a pose, and other poses that explain its matches."""

    verdict: BasinVerdict
    """`unique`: no second pose explains the matches; `ambiguous`: one does; `failed`: one is better, or too few starts
    return."""
    levels: tuple[BasinLevel, ...]
    """From the nearest to the farthest."""
    clusters: tuple[PoseCluster, ...]
    """Poses that explain a sample of the matches, the best first."""
    starts: int
    """Number of perturbed starts."""
    pose: Rigid
    """The pose under test."""
    other: Rigid | None
    """The pose that explains the matches as well (`ambiguous`) or better (`failed`), or None."""
    other_inliers: int
    """Number of inliers of that pose; 0 if there is none."""
    inliers: int
    """Number of inliers of the pose under test."""
    matches: int
    """Number of matches."""

    @property
    def size(self) -> BasinLevel | None:
        """The farthest level up to which at least `RETURN_SHARE` of the starts of every level return, or None."""
        reached = None
        for level in self.levels:
            if level.share < RETURN_SHARE:
                break
            reached = level
        return reached

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
        levels = [
            {
                "angle_rad": level.angle_rad,
                "distance_m": level.distance_m,
                "starts": level.starts,
                "home": level.returned,
            }
            for level in self.levels
        ]
        size = self.size
        reached = None if size is None else {"angle_rad": size.angle_rad, "distance_m": size.distance_m}
        other = None if self.other is None else self.other.matrix.tolist()
        return {"verdict": self.verdict, "starts": self.starts, "levels": levels, "size": reached, "other": other}

    def describe(self) -> str:
        """Return the verdict and the suggested action in words."""
        if self.other is not None:
            far, turned = self.pose.distance_to(self.other), np.degrees(self.pose.angle_to(self.other))
            where = f"{format_length(far)} and {turned:.2g}"
            if self.verdict == "ambiguous":
                return (
                    f"Two poses explain the matches: the second is {where} deg away ({self.other_inliers} inliers, "
                    f"this one {self.inliers}). Add matches off their common plane or line, near and far, and check "
                    "matches on repeated structure."
                )
            count = f"it has {self.other_inliers} of {self.matches} inliers, this one {self.inliers}"
            why = count if self.other_inliers > self.inliers else "its residuals are smaller"
            return f"A better pose lies {where} deg away: {why}. Use that pose, or solve again from it."
        nearest = self.levels[0]
        if self.verdict == "failed":
            return (
                f"Only {nearest.returned} of {nearest.starts} starting poses {_offset(nearest)} away converge to this "
                "pose. Correct or remove outliers, or add matches."
            )
        size = self.size
        if size is None:
            return (
                f"No other pose explains the matches, but only {nearest.returned} of {nearest.starts} starting poses "
                f"{_offset(nearest)} away converge to this one. Correct or remove outliers."
            )
        every = all(level.share == 1 for level in self.levels[: self.levels.index(size) + 1])
        return (
            f"{'All' if every else 'Nearly all'} starting poses up to {_offset(size)} away converge to this pose; no "
            "other pose explains the matches."
        )


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation:
    """A result after the test from many starting poses."""

    result: PoseResult
    """The result, with the verdict in its reasons and diagnostics."""
    verdict: BasinVerdict | None
    """`unique`, `ambiguous` or `failed`; None if the result was not accepted in the first place."""
    better: Rigid | None = None
    """A pose that explains the matches better, from which to solve again."""


def probe_basin(
    result: PoseResult,
    *,
    starts: int = 32,
    seed: int = 0,
    gate_chi2: float = 9.21,
    options: AcceptanceOptions = DEFAULT_ACCEPTANCE,
) -> Basin:
    """Determine the basin of attraction of a pose, and whether another pose explains its matches.

    The starting poses lie up to 40 degrees and half of the matches' distance away, in random directions. The cost is
    that of `solve_pose` over all matches, outliers included.

    Args:
        result: a pose with its matches and their noise, from any source.
        starts: number of starting poses, at least 8.
        seed: random seed; equal seeds give equal results.
        gate_chi2: largest cost s of an inlier, as `PoseOptions.gate_chi2`.
        options: thresholds of a second pose.

    Raises:
        OptionError: if the number of starts, the seed or the gate is invalid.
        DegenerateGeometryError: if there are fewer than 4 matches.
    """
    _check(result, starts, seed, gate_chi2)
    pose, points, gate = result.camera_from_scanner, result.matches.points, float(gate_chi2)
    measured = Measurements.of(
        result.matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m
    )
    reach = max(float(np.median(np.linalg.norm(pose @ points, axis=1))), 1e-9)
    given, seen = adjust_ranges(measured, States.of([pose], measured), rounds=1)
    agree = seen.s[0] <= gate
    members = points[agree] if np.count_nonzero(agree) >= MIN_MATCHES else points

    rng, share = np.random.default_rng(seed), max(float(np.mean(agree)), 1e-3)
    few = measured.subset(np.sort(rng.permutation(len(measured))[: min(_MAX_SAMPLE, round(_SAMPLE / share))]))
    level_of = np.sort(np.arange(starts) % len(_LEVELS_DEG))
    perturbed = _perturbed(pose, few, level_of, reach=reach, rng=rng)
    around = States.of(orbiting_poses(pose, members), few)
    ends, end_of = graduate_merging(few, perturbed.joined(around), gate=gate, reach=reach)
    promising = _promising_ends(few, ends, gate=gate, options=options)

    another = pose_of_outliers(
        result.matches, measured, ~agree, result.camera, sigma_px=result.sigma_px, seed=seed,
        options=options,
    )  # fmt: skip
    candidates = [pose] if another is None else [pose, another]
    rivals = 0 if another is None else count_rivals(another, measured, agree, gate=gate)
    settled = _refined_on_all(measured, candidates, ends.subset(promising), members, gate=gate, options=options)
    found = _cluster(measured, settled, gate=gate, reach=reach, options=options)
    cluster_of_end = np.full(len(ends.centres), -1)
    cluster_of_end[promising] = found.cluster_of[len(candidates) : len(candidates) + len(promising)]
    return _decide(
        result, found, cluster_of_end[end_of[:starts]], level_of,
        score=float(likelihood_scores(measured, given, gate)[0]), inliers=int(np.count_nonzero(agree)), reach=reach,
        rivals=rivals, options=options,
    )  # fmt: skip


def confirm(result: PoseResult, options: PoseOptions | None = None, *, starts: int = 32) -> Confirmation:
    """Test an accepted pose from many starting poses, and withdraw the acceptance if another pose explains its matches.

    The test contains the quick search for a second pose that `PoseOptions.check_ambiguity` leaves out.

    Args:
        result: a pose with its matches; returned unchanged if it is not accepted.
        options: seed and thresholds, as of the result.
        starts: number of starting poses.

    Raises:
        OptionError: if the number of starts is invalid.
    """
    if not result.accepted:
        return Confirmation(result, None)
    o = options or PoseOptions()
    basin = probe_basin(result, starts=starts, seed=o.seed, gate_chi2=o.gate_chi2, options=o.acceptance)
    second = basin.verdict == "ambiguous"
    diagnostics = {**result.diagnostics, "second_minimum": second, "basin": basin.as_dict()}
    if basin.verdict == "unique":
        confirmed = replace(result, reasons=(*result.reasons, basin.describe()), diagnostics=diagnostics)
        return Confirmation(confirmed, basin.verdict)
    refused = replace(
        result, accepted=False, evidence="none", reasons=(basin.describe(),), diagnostics=diagnostics
    )  # fmt: skip
    better = basin.other if basin.verdict == "failed" else None
    return Confirmation(refused, basin.verdict, better)


def _check(result: PoseResult, starts: int, seed: int, gate_chi2: float) -> None:
    for name, value, least, most in (("starts", starts, _MIN_STARTS, _MAX_STARTS), ("seed", seed, 0, 2**31 - 1)):
        require_int(value, f"{name}", least=least, most=most)
    if not 1e-3 <= gate_chi2 <= 1e6:
        raise OptionError(f"gate_chi2 is {gate_chi2!r}; it must be a number from 0.001 to 1e6")
    if len(result.matches) < MIN_MATCHES:
        raise DegenerateGeometryError(
            f"there are {len(result.matches)} matches and the test needs {MIN_MATCHES}; add matches"
        )


def _perturbed(pose: Rigid, few: Measurements, level_of: IntArray, *, reach: float, rng: np.random.Generator) -> States:
    axes, ways = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, len(level_of), 3)))
    angles, distances = np.deg2rad(_LEVELS_DEG)[level_of], np.array(_LEVELS_OF_DISTANCE)[level_of] * reach
    return States(
        rotations_from_rotvecs(axes * angles[:, None]) @ pose.rotation,
        pose.centre + ways * distances[:, None],
        np.tile(few.ranges, (len(level_of), 1)),
    )


def _refined_on_all(
    measured: Measurements,
    candidates: list[Rigid],
    ends: States,
    members: FloatArray,
    *,
    gate: float,
    options: AcceptanceOptions,
) -> States:
    """Refine candidates and ends on all matches, in this order; for planar inliers (N, 3) add their second poses."""
    flat = is_planar(members, options)
    poses = [*candidates, *(ends.pose(k) for k in range(len(ends.centres)))]
    if flat:
        poses.append(mirrored(candidates[0], members))
    full = States.of(poses, measured)
    settled, _ = graduate(measured, full, narrow_scales(full, gate), gate, last_steps=_LAST_STEPS)
    if not flat:
        return settled
    valley, _ = adjust_ranges(measured, States.of(poses_towards_mirrored(settled.pose(), members), measured))
    return settled.joined(refine_generalised(measured, settled, gate)).joined(valley)


def _promising_ends(few: Measurements, ends: States, *, gate: float, options: AcceptanceOptions) -> IntArray:
    """Return the indices of ends on a sample that may explain all matches, the best first."""
    s = residuals(few, ends).s
    scores = likelihood_scores(few, ends, gate)
    order = np.argsort(scores, kind="stable")[:_MAX_REFINED]
    # a second pose may score worse by the margin on all matches, and by chance on a sample
    most = scores[order[0]] + options.second_pose_margin * _noise(s[order[0]], gate) + 4 * np.sqrt(4 * len(few))
    return np.asarray(order[scores[order] <= most])


def _noise(s: FloatArray, gate: float) -> float:
    """Return chi^2/dof of the inliers, at least 1: the scale of score differences."""
    inside = s[s <= gate]
    return max(1.0, float(inside.sum()) / max(2 * len(inside) - 6, 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Clusters:
    """Clusters of poses refined on all matches, the best first."""

    states: States
    """The best pose of each of the K clusters."""
    scores: FloatArray
    """(K,) their `likelihood_scores`."""
    inliers: BoolArray
    """(K, N) the inliers of each."""
    information: FloatArray
    """(6, 6) at the best pose."""
    noise: float
    """chi^2/dof at the best pose, at least 1."""
    cluster_of: IntArray
    """The cluster of each refined state."""


def _cluster(
    measured: Measurements, settled: States, *, gate: float, reach: float, options: AcceptanceOptions
) -> _Clusters:
    """Group refined states into clusters."""
    s, scores = residuals(measured, settled).s, likelihood_scores(measured, settled, gate)
    best = np.array([int(np.argmin(scores))])
    H = information_matrix(measured, settled.subset(best), members=s[best[0]] <= gate)[0]
    noise = _noise(s[best[0]], gate)
    step = np.stack([pose_differences(settled.pose(k), settled)[0] for k in range(len(scores))])
    near = near_pairs(settled, _SAME_RAD, _SAME_OF_DISTANCE * reach)
    near &= ((step @ H) * step).sum(axis=-1) <= options.second_pose_sigmas**2 * noise
    cluster_of, leaders = group_by_leader(near, scores)
    return _Clusters(settled.subset(leaders), scores[leaders], s[leaders] <= gate, H, noise, cluster_of)


def _differs_from_minimum(result: PoseResult, found: _Clusters, cluster: int, options: AcceptanceOptions) -> bool:
    """Return whether a pose is further from the minimum of its cluster than the noise of both explains."""
    step = pose_differences(result.camera_from_scanner, found.states.subset(np.array([cluster])))[0][0]
    unit = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-300))
    C = guarded_inverse(found.information * np.outer(unit, unit)) * found.noise
    own = result.covariance / np.outer(unit, unit)
    if np.isfinite(own).all():
        C = C + own
    values, vectors = np.linalg.eigh((C + C.T) / 2)
    along = (step / unit) @ vectors
    return bool((along * along / np.maximum(values, MIN_EIGENVALUE)).sum() > options.second_pose_sigmas**2)


def _decide(
    result: PoseResult,
    found: _Clusters,
    ended: IntArray,
    level_of: IntArray,
    *,
    score: float,
    inliers: int,
    rivals: int,
    reach: float,
    options: AcceptanceOptions,
) -> Basin:
    """Compare the clusters and return the verdict.

    Args:
        result: the pose under test.
        found: the clusters; the first refined state was the pose under test.
        ended: (starts,) the cluster of each start; -1: none that explains the matches.
        level_of: (starts,) the level of each start.
        score: score of the pose as given.
        inliers: number of inliers of the pose as given.
        rivals: number of outliers that agree on another pose before its refinement, which was the second refined state.
        reach: distance of the matches from the camera, m.
        options: thresholds of a second pose.
    """
    own, margin = int(found.cluster_of[0]), options.second_pose_margin * found.noise
    other: int | None = None
    verdict: BasinVerdict = "unique"
    if found.scores[0] < found.scores[own] - margin:
        verdict, own, other = "failed", 0, 0
    elif score > found.scores[own] + margin and _differs_from_minimum(result, found, own, options):
        verdict, other = "failed", own
    else:
        beside = np.count_nonzero(found.inliers & ~found.inliers[own], axis=1)
        if rivals:  # refinement on all matches may lose one
            beside[found.cluster_of[1]] = max(beside[found.cluster_of[1]], rivals)
        second = (found.scores < found.scores[own] + margin) | (
            beside >= least_support(int(np.count_nonzero(found.inliers[own])), options)
        )
        second[own] = False
        if second.any():
            verdict, other = "ambiguous", int(np.argmax(second))
    returned = ended == own
    levels = tuple(
        BasinLevel(
            float(np.deg2rad(degrees)),
            of_distance * reach,
            int(np.count_nonzero(level_of == k)),
            int(np.count_nonzero(returned[level_of == k])),
        )
        for k, (degrees, of_distance) in enumerate(zip(_LEVELS_DEG, _LEVELS_OF_DISTANCE, strict=True))
    )
    if verdict == "unique" and levels[0].share < options.least_return_share:
        verdict = "failed"
    counts = np.count_nonzero(found.inliers, axis=1).tolist()
    clusters = tuple(
        PoseCluster(found.states.pose(k), float(found.scores[k]), counts[k], int(np.count_nonzero(ended == k)))
        for k in range(len(counts))
    )
    return Basin(
        verdict=verdict,
        levels=levels,
        clusters=clusters,
        starts=len(ended),
        pose=result.camera_from_scanner,
        inliers=inliers,
        matches=len(result.matches),
        other=None if other is None else clusters[other].pose,
        other_inliers=0 if other is None else clusters[other].inliers,
    )


def _offset(level: BasinLevel) -> str:
    return f"{np.degrees(level.angle_rad):.0f} deg and {format_length(level.distance_m)}"
