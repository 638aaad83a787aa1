"""The default estimator: right up to 70 % of mismatches, and as sure as the noise allows.

RANSAC twice, graduated non-convexity on the errors-in-variables cost, a gate, a last plain Levenberg-Marquardt; then
the noise, the ends of drawn lines and, where held-out matches ask for it, the camera.

Source: the methods named in the files of this room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid, principal_extents
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import LEAST_INLIERS
from ladarreg_core.pose.ambiguity import likelihood_scores, mirrored
from ladarreg_core.pose.bundle import (
    UNSEEN,
    Measurements,
    States,
    information_matrix,
    least_squares,
    linearise,
    residuals,
    settle,
)
from ladarreg_core.pose.checks import LEAST_MATCHES
from ladarreg_core.pose.cross_validation import choose_intrinsics, intrinsics_in_words, worse_when_held_out
from ladarreg_core.pose.gnc import graduate, narrow_scales, truncated_score, wide_scales
from ladarreg_core.pose.intrinsics import IntrinsicsFit, estimate_intrinsics
from ladarreg_core.pose.line_ends import repair_ends
from ladarreg_core.pose.options import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.pose.ransac import sample_pose
from ladarreg_core.pose.result import Fit, answer, noise_shown
from ladarreg_core.results import PoseResult

_GATE_ROUNDS = 5
_CLEAR_SHARE = 0.5
_NOISE_ROUNDS = 3
_FLAT = 0.25  # least over middle extent: above it only one of the two poses of a plane is left
_SETTLED_NOISE = 1.1  # a change of the noise below this factor changes neither inliers nor pose


def solve_robust(matches: Matches, camera: Camera, options: PoseOptions, *, initial: Rigid | None = None) -> PoseResult:
    """Estimate the pose of checked matches.

    Args:
        matches: M matches.
        camera: the photo's camera.
        options: how.
        initial: a first guess, tried beside those that RANSAC finds.

    Raises:
        DegenerateGeometryError: if no pose agrees with any 4 matches.
    """
    sigma = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    now = _Solution(matches, camera, sigma, _searched(matches, camera, options, sigma, initial))
    now = _with_repaired_ends(now, options)
    now = replace(now, fit=_on_its_right_side(now.fit.measured, now.fit, options))
    now = _with_noise_shown(now, options)
    if now.fit.count < LEAST_MATCHES:
        raise _no_pose(len(matches))
    now = _with_intrinsics(now, options)
    if initial is not None and options.keep_better_start:
        now = _unless_worse(now, initial, options)
    covariance = now.covariance
    if covariance is None:
        covariance = _covariance(information_matrix(now.fit.measured, now.fit.state, members=now.fit.inliers)[0])
    stopped = "settled" if now.fit.settled else "step limit"
    story = {"stopped": stopped, "noise_rounds": now.noise_rounds}
    result = answer(now.fit, now.matches, now.camera, options, covariance, now.sigma, story)
    return replace(result, camera_sigmas=now.camera_sigmas, reasons=(*result.reasons, *now.words))


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """What stands so far; each stage returns the next."""

    matches: Matches
    camera: Camera
    sigma: tuple[float, float]
    fit: Fit
    words: tuple[str, ...] = ()
    noise_rounds: int = 0
    covariance: FloatArray | None = None
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)

    def measured_by(self, sigma: tuple[float, float]) -> Measurements:
        return Measurements.of(self.matches, self.camera, sigma_px=sigma[0], sigma_range_m=sigma[1])


def _searched(
    matches: Matches, camera: Camera, options: PoseOptions, sigma: tuple[float, float], initial: Rigid | None
) -> Fit:
    """Return the best pose of RANSAC and of the first guess, with its inliers."""
    measured = Measurements.of(matches, camera, sigma_px=sigma[0], sigma_range_m=sigma[1])
    first = _first_poses(matches, measured, camera, options, sigma[0])
    if initial is not None:
        first.append(initial)
    if not first:
        raise _no_pose(len(matches))
    return _fit(measured, _best_of(measured, first, options, wide=initial is not None), options)


def _with_repaired_ends(now: _Solution, options: PoseOptions) -> _Solution:
    repaired = repair_ends(
        now.matches, now.fit.inliers, now.fit.state, now.camera,
        gate=options.gate_chi2, sigma_px=now.sigma[0], sigma_range_m=now.sigma[1],
    )  # fmt: skip
    if repaired.matches is now.matches:
        return now
    now = replace(now, matches=repaired.matches, words=(*now.words, *repaired.in_words()))
    return replace(now, fit=_fit(now.measured_by(now.sigma), now.fit.state, options))


def _with_noise_shown(now: _Solution, options: PoseOptions) -> _Solution:
    """Let noise and inliers answer each other until they stay, where a noise was not stated."""
    while (options.sigma_px is None or options.sigma_range_m is None) and now.fit.count >= LEAST_INLIERS:
        sigma = noise_shown(now.fit, now.matches, now.camera, options)
        change = max(max(a / b, b / a) for a, b in zip(sigma, now.sigma, strict=True))
        measured, rounds = now.measured_by(sigma), now.noise_rounds + 1
        last = change < _SETTLED_NOISE or rounds > _NOISE_ROUNDS
        start = now.fit.state
        if not last:
            scales = narrow_scales(start, options.gate_chi2)
            start, _ = graduate(measured, start, scales, options.gate_chi2, options.gnc)
        now = replace(now, sigma=sigma, fit=_fit(measured, start, options), noise_rounds=rounds)
        if last:
            break
    return now


def _with_intrinsics(now: _Solution, options: PoseOptions) -> _Solution:
    """Estimate what of the camera was asked for, or what the matches ask for."""
    if options.intrinsics == "fixed":
        return now
    unknown = options.sigma_px is None or options.sigma_range_m is None

    def noise(pose: Rigid, of: Camera, inliers: BoolArray) -> tuple[float, float]:
        if np.count_nonzero(inliers) < LEAST_INLIERS:
            return now.sigma
        there = replace(now.fit, state=States.of([pose], now.fit.measured), inliers=inliers)
        return noise_shown(there, now.matches, of, options)

    stated: dict[str, Any] = {
        "sigma_px": now.sigma[0], "sigma_range_m": now.sigma[1], "gate_chi2": options.gate_chi2,
        "noise": noise if unknown else None,
    }  # fmt: skip
    pose = now.fit.state.pose()
    free: IntrinsicsFit | None
    if options.intrinsics == "auto":
        choice = choose_intrinsics(now.matches, now.camera, pose, now.fit.inliers, seed=options.seed, **stated)
        free, words = choice.fit, choice.in_words()
    else:
        free = estimate_intrinsics(now.matches, now.camera, pose, options.intrinsics, **stated)
        words = intrinsics_in_words(free, now.camera)
    now = replace(now, words=(*now.words, *words))
    if free is None:
        return now
    now = replace(now, camera=free.camera, sigma=(free.sigma_px, free.sigma_range_m), camera_sigmas=free.sigmas)
    measured = now.measured_by(now.sigma)
    state, _ = settle(measured, States.of([free.pose], measured))
    fit = Fit(measured, state, free.inliers, free.s, free.settled, free=len(free.covariance))
    return replace(now, fit=fit, covariance=free.covariance[:6, :6])


def _unless_worse(now: _Solution, initial: Rigid, options: PoseOptions) -> _Solution:
    """Return to the first guess where it foretells held-out matches better than the pose fitted to the others."""
    worse = worse_when_held_out(
        now.matches, now.camera, initial, now.fit.state.pose(), now.fit.inliers,
        sigma_px=now.sigma[0], sigma_range_m=now.sigma[1], gate_chi2=options.gate_chi2, seed=options.seed,
    )  # fmt: skip
    if not worse:
        return now
    measured = now.fit.measured
    state, seen = settle(measured, States.of([initial], measured))
    fit = Fit(measured, state, seen.s[0] <= options.gate_chi2, seen.s[0], True)
    words = "The given pose foretells matches that were held out as well as a pose fitted to the others, and is kept."
    return replace(now, fit=fit, words=(*now.words, words))


def _on_its_right_side(measured: Measurements, fit: Fit, options: PoseOptions) -> Fit:
    """Return the likelier of a flat scene's two poses, the one found and the mirrored one."""
    if fit.count < LEAST_MATCHES:
        return fit
    points = (measured.rays * fit.state.rho[0])[:, fit.inliers].T
    extent = principal_extents(points)
    if extent[2] > _FLAT * extent[1]:
        return fit
    start = States.of([mirrored(fit.state.pose(), points)], measured)
    gate = options.gate_chi2
    turned, _ = graduate(measured, start, narrow_scales(start, gate, options.gnc), gate, options.gnc)
    if likelihood_scores(measured, turned, gate)[0] >= likelihood_scores(measured, fit.state, gate)[0]:
        return fit
    return _fit(measured, turned, options)


def _first_poses(
    matches: Matches, measured: Measurements, camera: Camera, options: PoseOptions, sigma_px: float
) -> list[Rigid]:
    """Return the poses of both RANSACs, those that there are."""
    if options.ransac_iterations == 0:
        return []
    ideal = camera.without_distortion()
    uv = (measured.xy * [[ideal.fx], [ideal.fy]] + [[ideal.cx], [ideal.cy]]).T
    threshold = options.ransac_sigma * sigma_px
    poses: list[Rigid] = []
    assert matches.across is not None
    uv[matches.across] = np.nan  # samples are of points
    for _ in range(2):
        pose = sample_pose(
            matches.points, uv, ideal, threshold_px=threshold, iterations=options.ransac_iterations,
            seed=options.seed, backend=options.ransac_backend,
        )  # fmt: skip
        if pose is None:
            break
        poses.append(pose)
        again, share = _second_threshold_px(measured, pose, ideal, options, gate_px=threshold)
        if np.isnan(again) or (again <= threshold and share > _CLEAR_SHARE):
            break  # a tighter threshold only matters where mismatches are many
        threshold = again
    return poses


def _second_threshold_px(
    measured: Measurements, pose: Rigid, camera: Camera, options: PoseOptions, *, gate_px: float
) -> tuple[float, float]:
    """Return the second RANSAC's threshold from the noise of ranges propagated into pixels, and the inliers' share.

    NaN where the pose has no inlier.
    """
    state = States.of([pose], measured)
    seen = residuals(measured, state)
    squared = (seen.e[0] ** 2).sum(axis=0) * (camera.fx * camera.fy)
    near = (squared < gate_px**2) & (seen.s[0] < UNSEEN)
    trace = measured.information.sum(axis=0)
    determinant = measured.information.prod(axis=0) - measured.cross_information[0] ** 2
    full = determinant > 1e-9 * trace * trace  # what is known across a line only has no pixel noise along it
    if not (near & full).any():
        return float("nan"), 0.0
    lin = linearise(measured, state, seen)
    own = trace / 2 / np.where(full, determinant, np.inf)
    by_range = (lin.j[0] ** 2).sum(axis=0) / measured.range_information
    sigma = float(np.sqrt(np.median((own + by_range)[near & full])) * camera.focal_px)
    return options.ransac_again_sigma * sigma, float(np.mean(near))


def _best_of(measured: Measurements, poses: Sequence[Rigid], options: PoseOptions, *, wide: bool) -> States:
    """Return the state (B = 1) of the lowest truncated score after closing the cost on every start."""
    gate = options.gate_chi2
    states = States.of(poses, measured)
    if len(poses) > 1:
        keep = np.array([int(np.argmin(truncated_score(residuals(measured, states).s, gate)))])
        if wide:
            keep = np.unique([*keep, len(poses) - 1])  # the guess that was given counts even where it is poor
        states = states.subset(keep)
    found, scores = graduate(measured, states, narrow_scales(states, gate, options.gnc), gate, options.gnc)
    best = found.subset(np.array([int(np.argmin(scores))]))
    share = np.mean(residuals(measured, best).s <= gate)
    if share < options.wide_below_share or options.ransac_iterations == 0:
        scales = wide_scales(measured, states, gate, options.gnc)
        other, other_scores = graduate(measured, states, scales, gate, options.gnc)
        if other_scores.min() < scores.min():
            best = other.subset(np.array([int(np.argmin(other_scores))]))
    return best


def _fit(measured: Measurements, state: States, options: PoseOptions) -> Fit:
    """Gate and descend in turn until the inliers stay the same."""
    gate, settled = options.gate_chi2, False
    seen = residuals(measured, state)
    inliers = seen.s[0] <= gate
    for _ in range(_GATE_ROUNDS):
        if np.count_nonzero(inliers) < LEAST_MATCHES:
            break
        state, seen, calm = least_squares(measured, state, members=inliers)
        settled = bool(calm[0])
        before, inliers = inliers, seen.s[0] <= gate
        if (before == inliers).all():
            break
    return Fit(measured, state, inliers, seen.s[0], settled)


def _covariance(information: FloatArray) -> FloatArray:
    """Invert the information; what it does not determine gets a variance that is huge but finite."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-13)) @ vectors.T / np.outer(scale, scale)
    return np.asarray((inverse + inverse.T) / 2)


def _no_pose(count: int) -> DegenerateGeometryError:
    return DegenerateGeometryError(
        f"no pose agrees with {LEAST_MATCHES} of the {count} matches; check the camera, or correct or add matches"
    )
