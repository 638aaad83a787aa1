"""`PoseResult` of a finished or stopped simplex, with covariance and verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.bundle import UNSEEN, Evaluation, States, adjust_ranges
from ladarreg_core.pose.estimators.covariance import simplex_covariance
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.options import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.pose.result import Fit, build_result, noise_of_inliers
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexFit


def build_simplex_result(found: SimplexFit, matches: Matches, camera: Camera, options: PoseOptions) -> PoseResult:
    """Return a simplex fit as a result, with residuals of all matches and a verdict on match statistics.

    Args:
        found: the fit.
        matches: the M matches that it was fitted to.
        camera: the photo's camera.
        options: the options of the solver; the noise is estimated if not stated.
    """
    sigma_px, sigma_m = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    pose = found.after.camera_from_scanner
    measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
    state, seen = adjust_ranges(measured, States.of([pose], measured))
    inliers = found.after.inliers & (seen.s[0] < UNSEEN)
    if (options.sigma_px is None or options.sigma_range_m is None) and np.count_nonzero(
        inliers
    ) >= options.acceptance.least_inliers():
        sigma_px, sigma_m = noise_of_inliers(pose, inliers, matches, camera, options)
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
        state, seen = adjust_ranges(measured, States.of([pose], measured))
    covariance = simplex_covariance(
        pose, matches, inliers, camera, residual=found.residual, sigma_px=sigma_px, sigma_range_m=sigma_m
    )
    fit = Fit(Evaluation(measured, state, seen), inliers, seen.s[0], found.stopped == "settled")
    result = build_result(fit, matches, camera, options, covariance, (sigma_px, sigma_m), found.diagnostics())
    if not found.collapsed:
        return result
    return replace(result, accepted=False, evidence="none", reasons=(found.describe(), *result.reasons))
