"""From a fitted pose to an answer that explains itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, principal_extents
from ladarreg_core.matches import Matches, across_lines
from ladarreg_core.pose.acceptance import MOST_ANGLE_RAD, MOST_POSITION_OF_RANGE, chance_agreement, judge, single_hold
from ladarreg_core.pose.ambiguity import competing_pose, rival_of_the_others
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, settle
from ladarreg_core.pose.diagnostics import derotated, diagnose, stereo_depth_error
from ladarreg_core.pose.noise import estimate_noise
from ladarreg_core.pose.options import STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.results import PoseResult

_MANY = 40
_FLAT = 0.3  # least over middle extent


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose fitted to its inliers."""

    measured: Measurements
    """All M matches."""
    state: States
    """The pose (B = 1)."""
    inliers: BoolArray
    """(M,) those that agree."""
    s: FloatArray
    """(M,) the cost of each match."""
    settled: bool
    """Whether the descent came to rest."""
    free: int = 6
    """How many parameters were fitted."""

    @property
    def count(self) -> int:
        """How many matches agree."""
        return int(np.count_nonzero(self.inliers))

    def chi2_per_dof(self, matches: Matches) -> float:
        """Return the inliers' sum of s over their degrees of freedom; NaN where there are none."""
        dof = int(matches.dimensions[self.inliers].sum()) - self.free
        return float(self.s[self.inliers].sum() / dof) if dof > 0 else float("nan")


def noise_shown(fit: Fit, matches: Matches, camera: Camera, options: PoseOptions) -> tuple[float, float]:
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


def answer(
    fit: Fit,
    matches: Matches,
    camera: Camera,
    options: PoseOptions,
    covariance: FloatArray,
    sigma: tuple[float, float],
    story: dict[str, Any],
) -> PoseResult:
    """Return a judged result.

    Args:
        fit: the pose with its inliers.
        matches: the matches that were fitted.
        camera: intrinsics, as given or estimated.
        options: how it was found.
        covariance: (6, 6) of (w, c).
        sigma: noise of pixels, px, and ranges, m.
        story: what else to tell of the search, JSON-ready.
    """
    pose, inliers, measured = fit.state.pose(), fit.inliers, fit.measured
    chi2 = fit.chi2_per_dof(matches)
    chance = chance_agreement(measured, matches, fit.state, inliers, camera, gate=options.gate_chi2)
    verdict: dict[str, Any] = {
        "pose": pose, "matches": matches, "inliers": inliers, "chi2_per_dof": chi2, "covariance": covariance,
        "log10_chance": chance,
    }  # fmt: skip
    accepted, reasons = judge(**verdict)
    rival = None
    if accepted:
        held_by = single_hold(
            measured, matches, fit.state, inliers,
            most_angle_rad=MOST_ANGLE_RAD, most_position_m=MOST_POSITION_OF_RANGE * float(np.median(matches.ranges)),
        )  # fmt: skip
        if held_by is not None:
            accepted, reasons = judge(**verdict, held_by=held_by)
    if accepted:  # what is refused already need not be searched for rivals
        rival = rival_of_the_others(matches, measured, inliers, camera, sigma_px=sigma[0], gate=options.gate_chi2)
        if rival is None and _may_have_rivals(matches.points[inliers]):
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


def _may_have_rivals(points: FloatArray) -> bool:
    """Return whether inliers (N, 3) are so few or so flat that another pose may explain them too.

    Known points off their plane leave a calibrated camera no second pose; what noise may do is a matter of few points.
    """
    extent = principal_extents(points)
    return len(points) < _MANY or bool(extent[2] <= _FLAT * extent[1])


def describe_pose(
    camera_from_scanner: Rigid,
    matches: Matches,
    inliers: BoolArray,
    camera: Camera,
    *,
    sigma_px: float,
    sigma_range_m: float,
    covariance: FloatArray,
) -> PoseResult:
    """Return residuals and diagnostics of a given pose, unjudged (`accepted` is False).

    Args:
        camera_from_scanner: the pose.
        matches: M matches; may be none.
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
        states, seen = settle(measured, States.of([pose], measured))
        s = seen.s[0]
        adjusted = np.where(s < UNSEEN, states.rho[0], np.nan)
    dof = int(matches.dimensions[inliers].sum()) - 6
    return PoseResult(
        camera_from_scanner=pose,
        camera=camera,
        matches=matches,
        inliers=inliers,
        residuals_px=across_lines(matches, matches.uv - camera.project(pose @ matches.points)),
        residuals_m=matches.ranges - adjusted,
        stereo_depth_error_m=stereo_depth_error(pose, matches, camera, sigma_px=sigma_px),
        covariance=covariance,
        chi2_per_dof=float(s[inliers].sum() / dof) if dof > 0 else float("nan"),
        sigma_px=float(sigma_px),
        sigma_range_m=float(sigma_range_m),
        diagnostics=diagnose(pose, matches, inliers, camera, sigma_px=sigma_px),
    )
