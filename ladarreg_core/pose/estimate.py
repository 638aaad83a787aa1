"""From matches to a pose that explains itself.

The default: RANSAC twice, graduated non-convexity on the errors-in-variables cost, a gate, a last plain
Levenberg-Marquardt. Source: the methods named in the files of this room.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, across_lines
from ladarreg_core.pose.ambiguity import competing_pose, likelihood_scores, mirrored
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
from ladarreg_core.pose.checks import LEAST_MATCHES, checked_matches
from ladarreg_core.pose.diagnostics import derotated, diagnose, singular_values, stereo_depth_error
from ladarreg_core.pose.gnc import DEFAULT_GNC, GncOptions, graduate, narrow_scales, truncated_score, wide_scales
from ladarreg_core.pose.line_ends import repair_ends
from ladarreg_core.pose.linear import linear_covariance, linear_pose
from ladarreg_core.pose.noise import estimate_noise
from ladarreg_core.pose.ransac import Backend, sample_pose
from ladarreg_core.pose.sandwich import simplex_covariance
from ladarreg_core.pose.stereo_simplex import DEFAULT_SIMPLEX, Residual, SimplexOptions, fit_simplex
from ladarreg_core.pose.verdict import LEAST_INLIERS, chance_agreement, judge
from ladarreg_core.results import PoseResult

Method = Literal["robust", "linear", "stereo_simplex", "epipolar_simplex"]

STATED_SIGMA_PX = 1.0
"""Pixel noise until the data tell, px."""
STATED_SIGMA_RANGE_M = 0.015
"""Range noise until the data tell, m."""

_log = logging.getLogger(__name__)
_LEAST_SIGMA, _MOST_SIGMA = 1e-6, 1e6
_GATE_ROUNDS = 5
_CLEAR_SHARE = 0.5
_NOISE_ROUNDS = 3
_FLAT = 0.25  # least over middle extent: above it only one of the two poses of a plane is left
_SETTLED_NOISE = 1.1  # a change of the noise below this factor changes neither inliers nor pose


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """How a pose is estimated."""

    method: Method = "robust"
    """`robust`, `linear` (thesis 2.4.1), `stereo_simplex` (Eq 2.21) or `epipolar_simplex` (without its poles)."""
    sigma_px: float | None = None
    """Pixel noise, px; None: 1 px, then as the matches show."""
    sigma_range_m: float | None = None
    """Range noise, m; None: .015 m, then as the matches show."""
    gate_chi2: float = 9.21
    """Largest s of an inlier: 99 % of chi-squared with two degrees of freedom."""
    ransac_sigma: float = 6.0
    """Threshold of the first RANSAC, in sigma_px."""
    ransac_again_sigma: float = 3.0
    """Threshold of the second RANSAC, in sigmas of the pixel with the range's noise propagated into it."""
    ransac_iterations: int = 5000
    """Samples at most; 0: none, and a first pose must be given."""
    ransac_backend: Backend = "auto"
    """`poselib`, `opencv`, or whichever is installed."""
    wide_below_share: float = 0.25
    """A wide start is tried beside the narrow one without RANSAC, or where that finds fewer inliers than this share.

    After RANSAC the narrow start lost none of 200 runs up to 80 % of mismatches; the wide one is for where it failed.
    """
    gnc: GncOptions = DEFAULT_GNC
    """How the robust cost closes."""
    simplex: SimplexOptions = DEFAULT_SIMPLEX
    """How a simplex walks and rejects; its `residual` is that of `method`."""
    seed: int = 0
    """Of every random choice."""

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise OptionError(f"the pose method is {self.method!r}; it must be one of {', '.join(get_args(Method))}")
        for name, unit in (("sigma_px", "pixels"), ("sigma_range_m", "metres")):
            sigma = getattr(self, name)
            if sigma is not None and not _between(sigma, _LEAST_SIGMA, _MOST_SIGMA):
                raise OptionError(
                    f"{name} is {sigma!r}; it must be a positive number of {unit} ({_LEAST_SIGMA:g} to {_MOST_SIGMA:g})"
                )
        for name in ("gate_chi2", "ransac_sigma", "ransac_again_sigma"):
            if not _between(getattr(self, name), 1e-3, 1e6):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be a positive number")
        if not isinstance(self.simplex, SimplexOptions):
            raise OptionError(f"simplex is a {type(self.simplex).__name__}; give SimplexOptions")
        for name in ("ransac_iterations", "seed"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value < 2**31:
                raise OptionError(f"{name} is {value!r}; it must be a whole number of at least 0")


def estimate_pose(
    rays: ArrayLike,
    ranges: ArrayLike,
    uv: ArrayLike,
    camera: Camera,
    *,
    sigma_px: float | None = None,
    sigma_range_m: float | None = None,
    method: Method = "robust",
    initial: Rigid | None = None,
    seed: int = 0,
) -> PoseResult:
    """Estimate where the camera was from point matches, mismatches among them, and judge the answer.

    Args:
        rays: (N, 3) unit, scanner frame.
        ranges: (N,) along the rays, m.
        uv: (N, 2), photo pixels.
        camera: the photo's camera; its lens may distort.
        sigma_px: pixel noise, px; None: estimated from the inliers' scatter where they are enough, else 1 px.
        sigma_range_m: range noise, m; None: likewise, else .015 m.
        method: `robust`, `linear`, `stereo_simplex` or `epipolar_simplex`.
        initial: a first guess of the pose: `robust` tries it beside those that it finds, a simplex starts there,
            `linear` needs none.
        seed: of every random choice; the same input and seed give the same answer.

    Returns:
        The pose with covariance, inliers, residuals of all matches and a verdict by `statistics`.

    Raises:
        ShapeError: if arrays disagree, or hold what is not finite, not positive (ranges) or not unit (rays, by more
            than 1e-3).
        DegenerateGeometryError: if there are fewer than 4 different matches (7 for `linear`), if the points lie on a
            line (on a plane, for `linear`), if no pose agrees with any 4 matches (`robust`), or if fewer than 4 lie in
            front of the scanner and within the lens (a simplex).
        OptionError: if a sigma, the method or the seed has no meaning.
        CameraError: if `camera` is none.
    """
    options = PoseOptions(method=method, sigma_px=sigma_px, sigma_range_m=sigma_range_m, seed=seed)
    rays = read_only(rays, np.float64, (None, 3), "the matches' rays")
    ranges = read_only(ranges, np.float64, (len(rays),), "the matches' ranges")
    matches = Matches(rays, ranges, read_only(uv, np.float64, (len(rays), 2), "the matches' pixels"))
    return solve_pose(matches, camera, options, initial=initial)


def solve_pose(
    matches: Matches, camera: Camera, options: PoseOptions | None = None, *, initial: Rigid | None = None
) -> PoseResult:
    """Estimate the pose of weighted matches; `estimate_pose` is this for bare arrays.

    Args:
        matches: M matches; a weight multiplies the information of its match.
        camera: the photo's camera.
        options: how.
        initial: a first guess.

    Raises:
        LadarregError: as `estimate_pose`.
    """
    options = options or PoseOptions()
    matches = checked_matches(matches, camera, initial)
    if options.method == "linear":
        return _solve_linear(matches, camera, options)
    if options.method in ("stereo_simplex", "epipolar_simplex"):
        return _solve_simplex(matches, camera, options, initial)
    return _solve_robust(matches, camera, options, initial)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A pose fitted to its inliers."""

    measured: Measurements
    state: States
    inliers: BoolArray
    s: FloatArray
    settled: bool

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.inliers))

    def chi2_per_dof(self, matches: Matches) -> float:
        """Return the inliers' sum of s over their degrees of freedom; NaN where there are none."""
        dof = int(matches.dimensions[self.inliers].sum()) - 6
        return float(self.s[self.inliers].sum() / dof) if dof > 0 else float("nan")


def _solve_robust(matches: Matches, camera: Camera, options: PoseOptions, initial: Rigid | None) -> PoseResult:
    sigma_px, sigma_m = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
    first = _first_poses(matches, measured, camera, options, sigma_px)
    if initial is not None:
        first.append(initial)
    if not first:
        raise _no_pose(len(matches))
    fit = _fit(measured, _best_of(measured, first, options, wide=initial is not None), options)
    repaired = repair_ends(
        matches, fit.inliers, fit.state, camera,
        gate=options.gate_chi2, sigma_px=sigma_px, sigma_range_m=sigma_m,
    )  # fmt: skip
    if repaired.matches is not matches:
        matches = repaired.matches
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
        fit = _fit(measured, fit.state, options)
    fit = _on_its_right_side(measured, fit, options)
    rounds = 0
    while (options.sigma_px is None or options.sigma_range_m is None) and fit.count >= LEAST_INLIERS:
        noise = _noise_shown(fit, matches, camera, options)
        change = max(noise[0] / sigma_px, sigma_px / noise[0], noise[1] / sigma_m, sigma_m / noise[1])
        sigma_px, sigma_m = noise
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
        rounds += 1
        last = change < _SETTLED_NOISE or rounds > _NOISE_ROUNDS
        start = fit.state if last else graduate(measured, fit.state, narrow_scales(fit.state, options.gate_chi2),
                                                options.gate_chi2, options.gnc)[0]  # fmt: skip
        fit = _fit(measured, start, options)
        if last:
            break
    if fit.count < LEAST_MATCHES:
        raise _no_pose(len(matches))
    covariance = _covariance(information_matrix(measured, fit.state, members=fit.inliers)[0])
    stopped = "settled" if fit.settled else "step limit"
    story = {"stopped": stopped, "noise_rounds": rounds}
    result = _result(fit, matches, camera, options, covariance, (sigma_px, sigma_m), story)
    return replace(result, reasons=(*result.reasons, *repaired.in_words()))


def _on_its_right_side(measured: Measurements, fit: _Fit, options: PoseOptions) -> _Fit:
    """Return the likelier of a flat scene's two poses, the one found and the mirrored one."""
    if fit.count < LEAST_MATCHES:
        return fit
    points = (measured.rays * fit.state.rho[0])[:, fit.inliers].T
    extent = singular_values(points)
    if extent[2] > _FLAT * extent[1]:
        return fit
    start = States.of([mirrored(fit.state.pose(), points)], measured)
    gate = options.gate_chi2
    turned, _ = graduate(measured, start, narrow_scales(start, gate, options.gnc), gate, options.gnc)
    if likelihood_scores(measured, turned, gate)[0] >= likelihood_scores(measured, fit.state, gate)[0]:
        return fit
    return _fit(measured, turned, options)


def _solve_linear(matches: Matches, camera: Camera, options: PoseOptions) -> PoseResult:
    sigma = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    measured = Measurements.of(matches, camera, sigma_px=sigma[0], sigma_range_m=sigma[1])
    xy = measured.xy.T
    beyond = int(np.count_nonzero(~np.isfinite(xy).all(axis=1)))
    if beyond:
        raise DegenerateGeometryError(
            f"{beyond} matches lie where the lens sees nothing and 'linear' uses all; remove them or use 'robust'"
        )
    pose = linear_pose(matches.points, xy)
    state, seen = settle(measured, States.of([pose], measured))
    fit = _Fit(measured, state, seen.s[0] <= options.gate_chi2, seen.s[0], True)
    assert matches.weights is not None
    root = np.sqrt(matches.weights)
    covariance = linear_covariance(
        pose, matches.points, matches.rays, xy,
        sigma_xy=sigma[0] / camera.focal_px / root, sigma_range_m=sigma[1] / root, seed=options.seed,
    )  # fmt: skip
    return _result(fit, matches, camera, options, covariance, sigma, {"stopped": "closed form"})


def _solve_simplex(matches: Matches, camera: Camera, options: PoseOptions, initial: Rigid | None) -> PoseResult:
    residual: Residual = "stereo" if options.method == "stereo_simplex" else "epipolar"
    sigma_px, sigma_m = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    how = replace(options.simplex, residual=residual)
    found = fit_simplex(matches, camera, how, initial=initial, sigma_px=sigma_px)
    pose = found.after.camera_from_scanner
    measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
    state, seen = settle(measured, States.of([pose], measured))
    inliers = found.after.inliers & (seen.s[0] < UNSEEN)
    if (options.sigma_px is None or options.sigma_range_m is None) and np.count_nonzero(inliers) >= LEAST_INLIERS:
        fit = _Fit(measured, state, inliers, seen.s[0], True)
        sigma_px, sigma_m = _noise_shown(fit, matches, camera, options)
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
        state, seen = settle(measured, States.of([pose], measured))
    covariance = simplex_covariance(
        pose, matches, inliers, camera, residual=residual, sigma_px=sigma_px, sigma_range_m=sigma_m
    )
    fit = _Fit(measured, state, inliers, seen.s[0], found.stopped == "settled")
    result = _result(fit, matches, camera, options, covariance, (sigma_px, sigma_m), found.story())
    if not found.collapsed:
        return result
    return replace(result, accepted=False, evidence="none", reasons=(found.in_words(), *result.reasons))


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
    if not near.any():
        return float("nan"), 0.0
    lin = linearise(measured, state, seen)
    determinant = measured.information.prod(axis=0) - measured.cross_information[0] ** 2
    own = measured.information.sum(axis=0) / 2 / np.maximum(determinant, 1e-300)
    by_range = (lin.j[0] ** 2).sum(axis=0) / measured.range_information
    sigma = float(np.sqrt(np.median((own + by_range)[near])) * camera.focal_px)
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


def _fit(measured: Measurements, state: States, options: PoseOptions) -> _Fit:
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
    return _Fit(measured, state, inliers, seen.s[0], settled)


def _noise_shown(fit: _Fit, matches: Matches, camera: Camera, options: PoseOptions) -> tuple[float, float]:
    """Return the noise that the inliers show, within what may still be called a match."""
    return estimate_noise(
        fit.state.pose(),
        matches.subset(fit.inliers),
        camera,
        stated_range_m=STATED_SIGMA_RANGE_M,
        most_px=max(3.0, 0.005 * max(camera.size)),
        most_range_m=max(0.05, 0.03 * float(np.median(matches.ranges))),
        fixed_px=options.sigma_px,
        fixed_range_m=options.sigma_range_m,
    )


def _covariance(information: FloatArray) -> FloatArray:
    """Invert the information; what it does not determine gets a variance that is huge but finite."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-13)) @ vectors.T / np.outer(scale, scale)
    return np.asarray((inverse + inverse.T) / 2)


def _result(
    fit: _Fit,
    matches: Matches,
    camera: Camera,
    options: PoseOptions,
    covariance: FloatArray,
    sigma: tuple[float, float],
    story: dict[str, Any],
) -> PoseResult:
    pose, inliers, measured = fit.state.pose(), fit.inliers, fit.measured
    chi2 = fit.chi2_per_dof(matches)
    chance = chance_agreement(measured, matches, fit.state, inliers, camera, gate=options.gate_chi2)
    verdict: dict[str, Any] = {
        "pose": pose, "matches": matches, "inliers": inliers, "chi2_per_dof": chi2, "covariance": covariance,
        "log10_chance": chance,
    }  # fmt: skip
    accepted, reasons = judge(**verdict)
    rival = None
    if accepted:  # what is refused already need not be searched for rivals
        rival = competing_pose(measured, fit.state, inliers, s=fit.s, gate=options.gate_chi2, chi2_per_dof=chi2)
        if rival is not None:
            accepted, reasons = judge(**verdict, rival=rival)
    disparities = derotated(pose, matches, camera)
    figures = diagnose(pose, matches, inliers, camera, sigma_px=sigma[0], disparities=disparities)
    figures |= {"method": options.method, "log10_chance": chance, "second_minimum": rival is not None, **story}
    seen = fit.s < UNSEEN
    return PoseResult(
        camera_from_scanner=pose,
        camera=camera,
        matches=matches,
        inliers=inliers,
        residuals_px=across_lines(matches, matches.uv - camera.project(pose @ matches.points)),
        residuals_m=np.where(seen, matches.ranges - fit.state.rho[0], np.nan),
        stereo_depth_error_m=stereo_depth_error(pose, matches, camera, sigma_px=sigma[0], disparities=disparities),
        covariance=covariance,
        chi2_per_dof=chi2,
        sigma_px=float(sigma[0]),
        sigma_range_m=float(sigma[1]),
        accepted=accepted,
        evidence="statistics" if accepted else "none",
        reasons=reasons,
        diagnostics=figures,
    )


def _no_pose(count: int) -> DegenerateGeometryError:
    return DegenerateGeometryError(
        f"no pose agrees with {LEAST_MATCHES} of the {count} matches; check the camera, or correct or add matches"
    )


def _between(value: Any, low: float, high: float) -> bool:
    try:
        return not isinstance(value, bool) and low <= float(value) <= high
    except (TypeError, ValueError):
        return False
