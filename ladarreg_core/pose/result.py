"""`PoseResult`s with residuals, diagnostics and verdict, from a fitted pose or from a given one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, median
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, across_lines
from ladarreg_core.pose.acceptance import (
    AcceptanceOptions,
    decide_acceptance,
    find_critical_match,
    find_inconsistent_match,
    log10_false_alarms,
)
from ladarreg_core.pose.ambiguity import find_second_pose, is_planar, second_pose_of_outliers
from ladarreg_core.pose.diagnostics import diagnose, stereo_depth_error, stereo_disparities
from ladarreg_core.pose.estimators.bundle import UNSEEN, Evaluation, States, adjust_ranges
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.noise import estimate_noise
from ladarreg_core.pose.options import STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.results.registration import PoseResult

_MAX_NOISE, _MAX_NOISE_DRAWN = 0.005, 0.02  # of the photo's longer side: of detected points, of lines by hand


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose fitted to its inliers."""

    at: Evaluation
    """All M matches at the pose."""
    inliers: BoolArray
    """(M,) bool."""
    s: FloatArray
    """(M,) cost of each match."""
    settled: bool
    """True if the optimisation converged."""
    free: int = 6
    """Number of fitted parameters."""

    @property
    def measured(self) -> Measurements:
        """All M matches."""
        return self.at.measured

    @property
    def state(self) -> States:
        """The pose (B = 1)."""
        return self.at.state

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inliers))

    def chi2_per_dof(self, matches: Matches) -> float:
        """Return the inliers' sum of s over their degrees of freedom; NaN without any."""
        dof = int(matches.dimensions[self.inliers].sum()) - self.free
        return float(self.s[self.inliers].sum() / dof) if dof > 0 else float("nan")


def noise_of_inliers(
    pose: Rigid,
    inliers: BoolArray,
    matches: Matches,
    camera: CameraModel,
    options: PoseOptions,
    *,
    gate_chi2: float = np.inf,
) -> tuple[float, float]:
    """Return (sigma_px, sigma_range_m) estimated from the inliers, within bounds for plausible matches."""
    share = _MAX_NOISE_DRAWN if matches.has_lines else _MAX_NOISE
    return estimate_noise(
        pose,
        matches,
        camera,
        members=inliers,
        stated_range_m=STATED_SIGMA_RANGE_M,
        most_px=max(3.0, share * max(camera.size)),
        most_range_m=max(0.05, 0.03 * median(matches.ranges)),
        fixed_px=options.sigma_px,
        fixed_range_m=options.sigma_range_m,
        gate_chi2=gate_chi2,
    )


def build_result(
    fit: Fit,
    matches: Matches,
    camera: CameraModel,
    options: PoseOptions,
    covariance: FloatArray,
    sigma: tuple[float, float],
    search: dict[str, Any],
    *,
    camera_uncertainty: CameraUncertainty | None = None,
) -> PoseResult:
    """Return the result of a fit, with a verdict on match statistics.

    Args:
        fit: the pose with its inliers.
        matches: the matches that were fitted.
        camera: intrinsics, as given or estimated.
        options: the options of the solver.
        covariance: (6, 6) of (w, c), for an exact camera.
        sigma: noise of pixels, px, and ranges, m.
        search: further diagnostics of the search, JSON-ready.
        camera_uncertainty: uncertainty of pose and camera, if the camera was fitted under a prior. The verdict is on
            the matches, for which the camera counts as exact.
    """
    whole = covariance if camera_uncertainty is None else camera_uncertainty.covariance[:6, :6]
    pose, inliers = fit.state.pose(), fit.inliers
    chi2 = fit.chi2_per_dof(matches)
    chance = log10_false_alarms(fit.at, matches, inliers, camera, gate=options.gate_chi2)
    verdict: dict[str, Any] = {
        "pose": pose, "matches": matches, "inliers": inliers, "chi2_per_dof": chi2, "covariance": covariance,
        "log10_chance": chance, "unknowns": fit.free, "second_pose_sought": options.check_ambiguity,
        "options": options.acceptance, "stated_covariance": whole,
    }  # fmt: skip
    accepted, reasons = decide_acceptance(**verdict)
    second_pose = None
    if accepted:
        faults: dict[str, Any] = {
            "critical_match": find_critical_match(fit.at, matches, inliers, options.acceptance),
            "inconsistent_match": find_inconsistent_match(
                fit.at, matches, inliers, unknowns=fit.free, options=options.acceptance
            ),
        }
        if any(faults.values()):
            accepted, reasons = decide_acceptance(**verdict, **faults)
    if accepted and options.check_ambiguity:  # the search is costly and cannot change a refusal
        second_pose = _second_pose(fit, matches, camera, options, sigma_px=sigma[0])
        if second_pose is not None:
            accepted, reasons = decide_acceptance(**verdict, second_pose=second_pose)
    disparities = stereo_disparities(pose, matches, camera)
    figures = diagnose(pose, matches, inliers, camera, sigma_px=sigma[0], disparities=disparities)
    figures |= {"method": options.method, "log10_chance": chance, "second_minimum": second_pose is not None, **search}
    seen = fit.s < UNSEEN
    return PoseResult(
        camera_from_scanner=pose,
        camera=camera,
        matches=matches,
        inliers=inliers,
        residuals_px=across_lines(matches, camera.difference(matches.uv, camera.project(pose @ matches.points))),
        residuals_m=np.where(seen, matches.ranges - fit.state.rho[0], np.nan),
        stereo_depth_error_m=stereo_depth_error(pose, matches, camera, sigma_px=sigma[0], disparities=disparities),
        covariance=whole,
        camera_uncertainty=camera_uncertainty,
        chi2_per_dof=chi2,
        sigma_px=float(sigma[0]),
        sigma_range_m=float(sigma[1]),
        accepted=accepted,
        evidence="statistics" if accepted else "none",
        reasons=reasons,
        diagnostics=figures,
    )


def _second_pose(
    fit: Fit, matches: Matches, camera: CameraModel, options: PoseOptions, *, sigma_px: float
) -> Rigid | None:
    """Return a second pose that explains the matches, by the quick search, or None."""
    acceptance, gate = options.acceptance, options.gate_chi2
    found = second_pose_of_outliers(
        matches, fit.measured, fit.inliers, camera, sigma_px=sigma_px, gate=gate, options=acceptance
    )
    if found is not None or not _may_be_ambiguous(matches.points[fit.inliers], acceptance):
        return found
    return find_second_pose(
        fit.measured, fit.state, fit.inliers,
        s=fit.s, gate=gate, chi2_per_dof=fit.chi2_per_dof(matches), options=acceptance,
    )  # fmt: skip


def _may_be_ambiguous(points: FloatArray, options: AcceptanceOptions) -> bool:
    """Return whether inliers (N, 3) are so few or so planar that a second pose may explain them.

    Many points with relief leave a calibrated camera no second pose; with few points noise may.
    """
    return len(points) < options.many_inliers or is_planar(points, options)


def inliers_at(
    camera_from_scanner: Rigid,
    matches: Matches,
    camera: CameraModel,
    *,
    sigma_px: float,
    sigma_range_m: float,
    gate_chi2: float,
) -> BoolArray:
    """Return which matches (M,) agree with a pose that was not fitted to them.

    Args:
        camera_from_scanner: the pose.
        matches: M matches, possibly none.
        camera: the photo's camera.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
        gate_chi2: largest cost s of one that agrees.
    """
    if not len(matches):
        return np.zeros(0, np.bool_)
    measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
    _, seen = adjust_ranges(measured, States.of([camera_from_scanner], measured))
    return np.asarray(seen.s[0] <= gate_chi2)


def describe_pose(
    camera_from_scanner: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: CameraModel,
    *,
    sigma_px: float,
    sigma_range_m: float,
    covariance: FloatArray,
) -> PoseResult:
    """Return residuals and diagnostics of a given pose, without a verdict (`accepted` is False).

    Args:
        camera_from_scanner: the pose.
        matches: M matches, possibly none.
        inliers: (M,) bool.
        camera: the photo's camera.
        sigma_px: pixel noise.
        sigma_range_m: range noise, m.
        covariance: (6, 6) as `PoseResult.covariance`.
    """
    pose, count = camera_from_scanner, len(matches)
    adjusted, s = np.full(count, np.nan), np.zeros(count)
    if count:
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        states, seen = adjust_ranges(measured, States.of([pose], measured))
        s = seen.s[0]
        adjusted = np.where(s < UNSEEN, states.rho[0], np.nan)
    dof = int(matches.dimensions[inliers].sum()) - 6
    return PoseResult(
        camera_from_scanner=pose,
        camera=camera,
        matches=matches,
        inliers=inliers,
        residuals_px=across_lines(matches, camera.difference(matches.uv, camera.project(pose @ matches.points))),
        residuals_m=matches.ranges - adjusted,
        stereo_depth_error_m=stereo_depth_error(pose, matches, camera, sigma_px=sigma_px),
        covariance=covariance,
        chi2_per_dof=float(s[inliers].sum() / dof) if dof > 0 else float("nan"),
        sigma_px=float(sigma_px),
        sigma_range_m=float(sigma_range_m),
        diagnostics=diagnose(pose, matches, inliers, camera, sigma_px=sigma_px),
    )
