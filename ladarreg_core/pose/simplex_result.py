"""What a simplex found, as a result that explains itself: the same for one that was watched and one that was not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import LEAST_INLIERS
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, settle
from ladarreg_core.pose.covariance import simplex_covariance
from ladarreg_core.pose.options import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M, PoseOptions
from ladarreg_core.pose.result import Fit, answer, noise_shown
from ladarreg_core.pose.thesis.stereo_simplex import SimplexFit
from ladarreg_core.results import PoseResult


def simplex_answer(found: SimplexFit, matches: Matches, camera: Camera, options: PoseOptions) -> PoseResult:
    """Return a fit with covariance, residuals of all matches and a verdict by `statistics`.

    Args:
        found: where the simplex ended, or was stopped.
        matches: M matches it walked on.
        camera: the photo's camera.
        options: the noise, where it is stated.
    """
    sigma_px, sigma_m = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    pose = found.after.camera_from_scanner
    measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
    state, seen = settle(measured, States.of([pose], measured))
    inliers = found.after.inliers & (seen.s[0] < UNSEEN)
    if (options.sigma_px is None or options.sigma_range_m is None) and np.count_nonzero(inliers) >= LEAST_INLIERS:
        fit = Fit(measured, state, inliers, seen.s[0], True)
        sigma_px, sigma_m = noise_shown(fit, matches, camera, options)
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_m)
        state, seen = settle(measured, States.of([pose], measured))
    covariance = simplex_covariance(
        pose, matches, inliers, camera, residual=found.residual, sigma_px=sigma_px, sigma_range_m=sigma_m
    )
    fit = Fit(measured, state, inliers, seen.s[0], found.stopped == "settled")
    result = answer(fit, matches, camera, options, covariance, (sigma_px, sigma_m), found.story())
    if not found.collapsed:
        return result
    return replace(result, accepted=False, evidence="none", reasons=(found.in_words(), *result.reasons))
