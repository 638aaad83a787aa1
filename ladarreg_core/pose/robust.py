"""The default estimator, robust to 70 % outliers and statistically efficient.

RANSAC twice, graduated non-convexity on the errors-in-variables cost, selection of the inliers, and a final
Levenberg-Marquardt without robust weights. Line ends are repaired and the noise estimated on the way; intrinsics are
estimated if that improves the prediction of held-out matches.

Source: the methods named in the modules of this package.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import log, pi, sqrt
from typing import Any

import numpy as np

from ladarreg_core.camera import CameraModel, require_pinhole
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, median
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.ambiguity import is_planar, likelihood_scores, mirrored
from ladarreg_core.pose.assumed_camera import fit_assumed_camera, with_assumed_camera
from ladarreg_core.pose.cross_validation import choose_intrinsics, describe_intrinsics, worse_when_held_out
from ladarreg_core.pose.drawn_scatter import scatter_between_lines
from ladarreg_core.pose.estimators.bundle import (
    UNSEEN,
    Evaluation,
    States,
    adjust_ranges,
    least_squares,
    linearise,
    residuals,
)
from ladarreg_core.pose.estimators.covariance import pose_covariance
from ladarreg_core.pose.estimators.gnc import DIVIDE_BY, graduate, narrow_scales, truncated_score, wide_scales
from ladarreg_core.pose.estimators.intrinsics import IntrinsicsFit, Noise, estimate_intrinsics
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.estimators.ransac import sample_pose
from ladarreg_core.pose.estimators.ray_ransac import sample_pose_of_rays
from ladarreg_core.pose.line_ends import repair_ends
from ladarreg_core.pose.options import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.pose.preconditions import MIN_MATCHES
from ladarreg_core.pose.result import Fit, build_result, noise_of_inliers
from ladarreg_core.results.registration import PoseResult

_GATE_ROUNDS = 5
_CLEAR_SHARE = 0.5
_RANSAC_SIGMA = 6.0  # threshold of the first RANSAC, in sigma_px
_RANSAC_AGAIN_SIGMA = 3.0  # of the second, in sigmas of the pixel noise including the propagated range noise
_WIDE_BELOW_SHARE = 0.25
"""A wide start is tried as well if RANSAC is disabled or finds a smaller share of inliers than this.

After RANSAC the narrow start failed in none of 200 runs with up to 80 % outliers; the wide one covers a failed RANSAC.
"""
_NOISE_ROUNDS = 3
_SETTLED_NOISE = 1.1  # a smaller change of the noise changes neither inliers nor pose
_LITTLE_NOISE = (
    1.3,
    2.0,
)  # of pixels and of ranges: up to such changes the inliers are selected again from the pose found
_DRAWN_SIGMAS_PX = (STATED_SIGMA_PX, 2.0, 4.0, 8.0)
"""Noise that lines drawn by hand may have: at first, before it is estimated, px."""
_FINAL_SIGMA, _PASSING_SIGMA = 1e-2, 2.0  # the last step; one step of 2 sigma leaves an error of some .004


def solve_robust(
    matches: Matches, camera: CameraModel, options: PoseOptions, initial: Rigid | None = None, *, assumed: bool = False
) -> PoseResult:
    """Estimate the pose from matches that meet the preconditions.

    Args:
        matches: M matches.
        camera: the photo's camera.
        options: options of the estimator.
        initial: an initial pose, tried as well as those from RANSAC.
        assumed: whether the camera has the prior of the options.

    Raises:
        DegenerateGeometryError: if no pose has 4 inliers.
    """
    solution = _likeliest(_solutions(matches, camera, options, initial))
    if solution.fit.count < MIN_MATCHES:
        raise _no_pose(len(matches))
    solution = _with_intrinsics(solution, options)
    if initial is not None and options.keep_better_start:
        solution = _or_initial_pose(solution, initial, options)
    result = _result(solution, options)
    return _with_assumed_camera(result, solution, camera, options) if assumed else result


def _solutions(
    matches: Matches, camera: CameraModel, options: PoseOptions, initial: Rigid | None
) -> Iterator[_Solution]:
    """Yield the solution from every noise that the matches may have: a hand that draws lines may be careful or not.

    Raises:
        DegenerateGeometryError: if no pose is found with any of them.
    """
    levels: tuple[float, ...] = (options.sigma_px or STATED_SIGMA_PX,)
    if matches.has_lines and options.sigma_px is None:
        levels = _DRAWN_SIGMAS_PX
    for level, sigma_px in enumerate(levels, 1):
        sigma = sigma_px, options.sigma_range_m or STATED_SIGMA_RANGE_M
        try:
            solution = _Solution(matches, camera, sigma, _initial_fit(matches, camera, options, sigma, initial))
        except DegenerateGeometryError:
            if level == len(levels):
                raise
            continue
        solution = _with_repaired_ends(solution, options)
        solution = replace(solution, fit=_likelier_of_mirrored(solution.fit.measured, solution.fit, options))
        yield _with_estimated_noise(solution, options)


def _likeliest(solutions: Iterator[_Solution]) -> _Solution:
    """Return the likeliest solution, where an outlier lies anywhere in the photograph."""
    return min(solutions, key=_deviance)


def _deviance(solution: _Solution) -> float:
    """Return -2 log likelihood of the matches: inliers have the noise of the solution, outliers are uniform."""
    dimensions, inliers = solution.matches.dimensions, solution.fit.inliers
    size = float(np.prod(solution.camera.size))
    of_inliers = solution.fit.s + dimensions * log(2 * pi * solution.sigma[0] ** 2)
    return float(np.where(inliers, of_inliers, dimensions * log(size)).sum())


def _result(
    solution: _Solution, options: PoseOptions, camera_uncertainty: CameraUncertainty | None = None
) -> PoseResult:
    covariance = solution.covariance
    if covariance is None:
        covariance = pose_covariance(solution.fit.at.information(solution.fit.inliers))
    if solution.matches.has_lines and options.sigma_px is None:
        scatter = scatter_between_lines(
            solution.fit.at, solution.matches, solution.fit.inliers, sigma_px=solution.sigma[0]
        )
        covariance = covariance + scatter
        if camera_uncertainty is not None:
            camera_uncertainty = camera_uncertainty.with_scatter(scatter)
    stopped = "settled" if solution.fit.settled else "step limit"
    search = {"stopped": stopped, "noise_rounds": solution.noise_rounds}
    result = build_result(
        solution.fit, solution.matches, solution.camera, options, covariance, solution.sigma, search,
        camera_uncertainty=camera_uncertainty,
    )  # fmt: skip
    return replace(result, camera_sigmas=solution.camera_sigmas, reasons=(*result.reasons, *solution.notes))


def _with_assumed_camera(
    result: PoseResult, solution: _Solution, stated: CameraModel, options: PoseOptions
) -> PoseResult:
    """Return the result with the camera fitted under its prior, or else with the camera's errors in its covariance.

    The camera is kept as it was where the pose, too, is to be kept, and where the pose would no longer be accepted.
    """
    kept = with_assumed_camera(result, options.camera_prior)
    if options.intrinsics == "fixed" or solution.kept_initial or (as_stated := stated.as_pinhole) is None:
        return kept
    given = require_pinhole(solution.camera, "An assumed camera")
    start = solution.intrinsics or (given, solution.fit.state.pose())
    found = fit_assumed_camera(
        solution.matches, as_stated, start, options.camera_prior,
        sigma_px=solution.sigma[0], sigma_range_m=solution.sigma[1], gate_chi2=options.gate_chi2,
        noise=_noise_estimator(solution, options),
    )  # fmt: skip
    if found is None or np.count_nonzero(found[0].inliers) < MIN_MATCHES:
        return kept
    free, uncertainty = found
    solution = replace(solution, camera=free.camera, sigma=(free.sigma_px, free.sigma_range_m))
    if solution.intrinsics is not None:
        sigmas = {name: uncertainty.sigmas[name] for name in solution.camera_sigmas}
        solution = replace(solution, camera_sigmas=sigmas)
    measured = solution.measured_by(solution.sigma)
    at = Evaluation(measured, *adjust_ranges(measured, States.of([free.pose], measured)))
    fit = Fit(at, free.inliers, free.s, free.settled, free=solution.fit.free)
    fitted = _result(replace(solution, fit=fit), options, uncertainty)
    return fitted if fitted.accepted or not result.accepted else kept


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """The solution so far; each step of the estimator returns the next."""

    matches: Matches
    camera: CameraModel
    sigma: tuple[float, float]
    fit: Fit
    notes: tuple[str, ...] = ()
    noise_rounds: int = 0
    covariance: FloatArray | None = None
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)
    intrinsics: IntrinsicsFit | None = None
    kept_initial: bool = False

    def measured_by(self, sigma: tuple[float, float]) -> Measurements:
        return Measurements.of(self.matches, self.camera, sigma_px=sigma[0], sigma_range_m=sigma[1])


def _initial_fit(
    matches: Matches, camera: CameraModel, options: PoseOptions, sigma: tuple[float, float], initial: Rigid | None
) -> Fit:
    """Return the best of the RANSAC poses and the initial pose, with its inliers."""
    measured = Measurements.of(matches, camera, sigma_px=sigma[0], sigma_range_m=sigma[1])
    first = _initial_poses(matches, measured, camera, options, sigma[0])
    if initial is not None:
        first.append(initial)
    if not first:
        raise _no_pose(len(matches))
    best = _best_of(measured, first, options, wide=initial is not None)
    # With open noise this fit only serves to estimate it.
    return _fit(measured, best, options, tolerance_sigma=_PASSING_SIGMA if _noise_is_open(options) else _FINAL_SIGMA)


def _with_repaired_ends(solution: _Solution, options: PoseOptions) -> _Solution:
    repaired = repair_ends(
        solution.matches, solution.fit.inliers, solution.fit.state, solution.camera,
        gate=options.gate_chi2, sigma_px=solution.sigma[0], sigma_range_m=solution.sigma[1],
    )  # fmt: skip
    if repaired.matches is solution.matches:
        return solution
    solution = replace(solution, matches=repaired.matches, notes=(*solution.notes, *repaired.describe()))
    return replace(solution, fit=_fit(solution.measured_by(solution.sigma), solution.fit.state, options))


def _with_estimated_noise(solution: _Solution, options: PoseOptions) -> _Solution:
    """Alternate between estimating unstated noise and selecting inliers until both are stable."""
    if not _noise_is_open(options):
        return solution
    last = False
    while not last and solution.fit.count >= options.acceptance.least_inliers():
        fit, rounds = solution.fit, solution.noise_rounds + 1
        sigma = _noise_of(fit.state.pose(), fit.inliers, solution.matches, solution.camera, options)
        of_px, of_range = (a / b for a, b in zip(sigma, solution.sigma, strict=True))
        px_change, range_change = max(of_px, 1 / of_px), max(of_range, 1 / of_range)
        measured = fit.measured.with_noise(px_factor=of_px, range_factor=of_range)
        last = max(px_change, range_change) < _SETTLED_NOISE or rounds > _NOISE_ROUNDS
        little = px_change <= _LITTLE_NOISE[0] and range_change <= _LITTLE_NOISE[1]
        start = fit.state
        if not last:
            scales = narrow_scales(start, options.gate_chi2)
            if little:
                scales = np.array([options.gate_chi2 * DIVIDE_BY])
            start, _ = graduate(measured, start, scales, options.gate_chi2)
        before = fit.inliers
        fit = _fit(measured, start, options, tolerance_sigma=_FINAL_SIGMA if last else _PASSING_SIGMA)
        same = not last and little and bool((fit.inliers == before).all())
        solution = replace(solution, sigma=sigma, fit=fit, noise_rounds=rounds)
        if same:  # the same matches have the same noise
            break
    if last:
        return solution
    return replace(solution, fit=_fit(solution.fit.measured, solution.fit.state, options))


def _noise_of(
    pose: Rigid, inliers: BoolArray, matches: Matches, camera: CameraModel, options: PoseOptions
) -> tuple[float, float]:
    return noise_of_inliers(pose, inliers, matches, camera, options, gate_chi2=options.gate_chi2)


def _noise_is_open(options: PoseOptions) -> bool:
    return options.sigma_px is None or options.sigma_range_m is None


def _with_intrinsics(solution: _Solution, options: PoseOptions) -> _Solution:
    """Estimate the intrinsics that were requested, or those that held-out matches support."""
    if options.intrinsics == "fixed" or (camera := solution.camera.as_pinhole) is None:
        return solution
    stated: dict[str, Any] = {
        "sigma_px": solution.sigma[0], "sigma_range_m": solution.sigma[1], "gate_chi2": options.gate_chi2,
        "noise": _noise_estimator(solution, options),
    }  # fmt: skip
    pose = solution.fit.state.pose()
    free: IntrinsicsFit | None
    if options.intrinsics == "auto":
        choice = choose_intrinsics(
            solution.matches,
            camera,
            pose,
            solution.fit.inliers,
            at=solution.fit.at,
            seed=options.seed,
            **stated,
        )
        free, words = choice.fit, choice.describe()
    else:
        free = estimate_intrinsics(solution.matches, camera, pose, options.intrinsics, **stated)
        words = describe_intrinsics(free, camera)
    solution = replace(solution, notes=(*solution.notes, *words))
    if free is None:
        return solution
    solution = replace(
        solution,
        camera=free.camera,
        sigma=(free.sigma_px, free.sigma_range_m),
        camera_sigmas=free.sigmas,
        intrinsics=free,
    )
    measured = solution.measured_by(solution.sigma)
    at = Evaluation(measured, *adjust_ranges(measured, States.of([free.pose], measured)))
    fit = Fit(at, free.inliers, free.s, free.settled, free=len(free.covariance))
    return replace(solution, fit=fit, covariance=free.covariance[:6, :6])


def _noise_estimator(solution: _Solution, options: PoseOptions) -> Noise | None:
    """Return the estimator of the noise from a pose and its camera; None if the noise is stated."""

    def noise(pose: Rigid, of: CameraModel, inliers: BoolArray) -> tuple[float, float]:
        if np.count_nonzero(inliers) < options.acceptance.least_inliers():
            return solution.sigma
        return _noise_of(pose, inliers, solution.matches, of, options)

    return noise if _noise_is_open(options) else None


def _or_initial_pose(solution: _Solution, initial: Rigid, options: PoseOptions) -> _Solution:
    """Return to the initial pose if it predicts held-out matches better than a pose fitted to the others."""
    camera = solution.camera.as_pinhole
    if camera is None:
        return solution
    worse = worse_when_held_out(
        solution.matches, camera, initial, solution.fit.state.pose(), solution.fit.inliers,
        sigma_px=solution.sigma[0], sigma_range_m=solution.sigma[1], gate_chi2=options.gate_chi2, seed=options.seed,
    )  # fmt: skip
    if not worse:
        return solution
    measured = solution.fit.measured
    state, seen = adjust_ranges(measured, States.of([initial], measured))
    fit = Fit(Evaluation(measured, state, seen), seen.s[0] <= options.gate_chi2, seen.s[0], True)
    words = "The initial pose predicts held-out matches at least as well as a pose fitted to the others, and is kept."
    return replace(solution, fit=fit, notes=(*solution.notes, words), kept_initial=True)


def _likelier_of_mirrored(measured: Measurements, fit: Fit, options: PoseOptions) -> Fit:
    """Return the likelier of the two poses of a planar scene: the one found or the mirrored one."""
    if fit.count < MIN_MATCHES:
        return fit
    points = (measured.rays * fit.state.rho[0])[:, fit.inliers].T
    if not is_planar(points, options.acceptance):
        return fit
    start = States.of([mirrored(fit.state.pose(), points)], measured)
    gate = options.gate_chi2
    mirror, _ = graduate(measured, start, narrow_scales(start, gate), gate)
    if likelihood_scores(measured, mirror, gate)[0] >= likelihood_scores(measured, fit.state, gate)[0]:
        return fit
    return _fit(measured, mirror, options)


def _initial_poses(
    matches: Matches, measured: Measurements, camera: CameraModel, options: PoseOptions, sigma_px: float
) -> list[Rigid]:
    """Return the poses found by the two runs of RANSAC, at most one each."""
    if options.ransac_iterations == 0:
        return []
    pinhole = camera.as_pinhole
    if pinhole is None:
        return _initial_poses_of_rays(matches, camera, options, sigma_px)
    ideal = pinhole.without_distortion()
    uv = (measured.xy * [[ideal.fx], [ideal.fy]] + [[ideal.cx], [ideal.cy]]).T
    threshold = _RANSAC_SIGMA * sigma_px
    poses: list[Rigid] = []
    uv[matches.across] = np.nan  # sample points only
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
            break  # a tighter threshold only matters with many outliers
        threshold = again
    return poses


def _initial_poses_of_rays(matches: Matches, camera: CameraModel, options: PoseOptions, sigma_px: float) -> list[Rigid]:
    """Return the pose found from the rays of a wide camera, if any."""
    pose = sample_pose_of_rays(
        matches.points[~matches.across], camera.unproject(matches.uv[~matches.across]),
        threshold_rad=_RANSAC_SIGMA * sigma_px / camera.focal_px, iterations=options.ransac_iterations,
        seed=options.seed,
    )  # fmt: skip
    return [] if pose is None else [pose]


def _second_threshold_px(
    measured: Measurements, pose: Rigid, camera: CameraModel, options: PoseOptions, *, gate_px: float
) -> tuple[float, float]:
    """Return the threshold of the second RANSAC, from range noise propagated into pixels, and the share of inliers.

    The threshold is NaN if the pose has no inlier.
    """
    state = States.of([pose], measured)
    seen = residuals(measured, state)
    x, y = seen.e[0]
    squared = (x * x + y * y) * camera.focal_px**2
    near = (squared < gate_px**2) & (seen.s[0] < UNSEEN)
    xx, yy = measured.information
    trace, determinant = xx + yy, xx * yy - measured.cross_information[0] ** 2
    full = near & (determinant > 1e-9 * trace * trace)  # rank 1 for line ends known only across the line
    if not full.any():
        return float("nan"), 0.0
    a, b = linearise(measured, state, seen).j[0]
    variance = trace[full] / 2 / determinant[full] + ((a * a + b * b) / measured.range_information)[full]
    sigma = sqrt(median(variance)) * camera.focal_px
    return _RANSAC_AGAIN_SIGMA * sigma, float(np.mean(near))


def _best_of(measured: Measurements, poses: Sequence[Rigid], options: PoseOptions, *, wide: bool) -> States:
    """Return the state (B = 1) of the lowest truncated score after graduated non-convexity from every pose."""
    gate = options.gate_chi2
    states = States.of(poses, measured)
    if len(poses) > 1:
        keep = np.array([int(np.argmin(truncated_score(residuals(measured, states).s, gate)))])
        if wide:
            keep = np.unique([*keep, len(poses) - 1])  # keep the initial pose even if it scores poorly
        states = states.subset(keep)
    found, scores = graduate(measured, states, narrow_scales(states, gate), gate)
    best = found.subset(np.array([int(np.argmin(scores))]))
    share = np.mean(residuals(measured, best).s <= gate)
    if share < _WIDE_BELOW_SHARE or options.ransac_iterations == 0:
        scales = wide_scales(measured, states, gate)
        other, other_scores = graduate(measured, states, scales, gate)
        if other_scores.min() < scores.min():
            best = other.subset(np.array([int(np.argmin(other_scores))]))
    return best


def _fit(measured: Measurements, state: States, options: PoseOptions, *, tolerance_sigma: float = _FINAL_SIGMA) -> Fit:
    """Alternate between selecting inliers and least squares until the inliers are stable."""
    gate, settled = options.gate_chi2, False
    seen = residuals(measured, state)
    inliers = seen.s[0] <= gate
    for _ in range(_GATE_ROUNDS):
        if np.count_nonzero(inliers) < MIN_MATCHES:
            break
        state, seen, calm = least_squares(measured, state, members=inliers, seen=seen, tolerance_sigma=tolerance_sigma)
        settled = bool(calm[0])
        before, inliers = inliers, seen.s[0] <= gate
        if (before == inliers).all():
            break
    return Fit(Evaluation(measured, state, seen), inliers, seen.s[0], settled)


def _no_pose(count: int) -> DegenerateGeometryError:
    return DegenerateGeometryError(
        f"no pose agrees with {MIN_MATCHES} of the {count} matches; check the camera, or correct or add matches"
    )
