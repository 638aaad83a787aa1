"""Pose estimation from matches, by the default estimator or one of the thesis's; the table of methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import Camera, CameraModel, require_pinhole
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.assumed_camera import with_assumed_camera
from ladarreg_core.pose.estimators.bundle import Evaluation, States, adjust_ranges
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.estimators.unknown_intrinsics import Intrinsics
from ladarreg_core.pose.options import STATED_SIGMA_PX as STATED_SIGMA_PX
from ladarreg_core.pose.options import STATED_SIGMA_RANGE_M as STATED_SIGMA_RANGE_M
from ladarreg_core.pose.options import Method as Method
from ladarreg_core.pose.options import PoseOptions as PoseOptions
from ladarreg_core.pose.preconditions import check_matches
from ladarreg_core.pose.result import Fit, build_result
from ladarreg_core.pose.robust import solve_robust
from ladarreg_core.pose.simplex_result import build_simplex_result
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.thesis.estimators.linear import linear_covariance, linear_pose
from ladarreg_core.thesis.estimators.stereo_simplex import Residual, fit_simplex


def estimate_pose(
    rays: ArrayLike,
    ranges: ArrayLike,
    uv: ArrayLike,
    camera: CameraModel,
    *,
    sigma_px: float | None = None,
    sigma_range_m: float | None = None,
    method: Method = "robust",
    initial: Rigid | None = None,
    intrinsics: Intrinsics | Literal["auto"] = "auto",
    seed: int = 0,
) -> PoseResult:
    """Estimate the camera pose from point matches that may contain outliers, with a verdict on the result.

    Args:
        rays: (N, 3) unit, scanner frame.
        ranges: (N,) along the rays, m.
        uv: (N, 2), photo pixels.
        camera: the photo's camera, with or without lens distortion.
        sigma_px: pixel noise, px; None: estimated from the inliers if there are enough, else 1 px.
        sigma_range_m: range noise, m; None: likewise, else .015 m.
        method: `robust`, `linear`, `stereo_simplex` or `epipolar_simplex`.
        initial: an initial pose: `robust` tries it as a further candidate, a simplex starts from it, `linear` ignores
            it.
        intrinsics: the intrinsics that `robust` estimates with the pose: `fixed` (none), `focal`, `focal_k1`,
            `focal_k1_centre`, or `auto`: the focal length, then k1, each only if it clearly improves the prediction
            of held-out matches.
        seed: random seed; equal seeds give equal results.

    Returns:
        The pose with covariance, inliers, residuals of all matches and a verdict on match statistics.

    Raises:
        ShapeError: if the shapes disagree, a number is not finite, a range is not positive or the length of a ray
            differs from 1 by more than 1e-3.
        DegenerateGeometryError: if there are fewer than 4 distinct matches (7 for `linear`), if the points are
            collinear (coplanar, for `linear`), if no pose has 4 inliers (`robust`), or if fewer than 4 matches lie in
            front of the scanner and within the field of the lens (a simplex).
        OptionError: if a sigma, the method or the seed is invalid.
        CameraError: if `camera` is not a Camera.
    """
    options = PoseOptions(
        method=method, sigma_px=sigma_px, sigma_range_m=sigma_range_m, intrinsics=intrinsics, seed=seed
    )
    rays = read_only(rays, np.float64, (None, 3), "the matches' rays")
    ranges = read_only(ranges, np.float64, (len(rays),), "the matches' ranges")
    matches = Matches(rays, ranges, read_only(uv, np.float64, (len(rays), 2), "the matches' pixels"))
    return solve_pose(matches, camera, options, initial=initial)


def solve_pose(
    matches: Matches,
    camera: CameraModel,
    options: PoseOptions | None = None,
    *,
    initial: Rigid | None = None,
    assumed: bool = False,
) -> PoseResult:
    """Estimate the pose from weighted matches; `estimate_pose` does the same for plain arrays.

    Args:
        matches: M matches; a weight multiplies the information of its match.
        camera: the photo's camera.
        options: method and options; None: the defaults.
        initial: an initial pose.
        assumed: whether only the focal length of the camera is known, as `Photo.assumed`: `PoseOptions.camera_prior`
            then becomes part of the uncertainty, and `robust` fits the camera with the pose.

    Raises:
        LadarregError: as `estimate_pose`.
    """
    options = options or PoseOptions()
    matches = check_matches(matches, camera, initial)
    if options.method == "robust":
        return solve_robust(matches, camera, options, initial, assumed=assumed)
    pinhole = require_pinhole(camera, f"The method '{options.method}'")
    found = _METHODS[options.method](matches, pinhole, options, initial)
    return with_assumed_camera(found, options.camera_prior) if assumed else found


def _solve_linear(matches: Matches, camera: Camera, options: PoseOptions, _: Rigid | None) -> PoseResult:
    sigma = options.sigma_px or STATED_SIGMA_PX, options.sigma_range_m or STATED_SIGMA_RANGE_M
    measured = Measurements.of(matches, camera, sigma_px=sigma[0], sigma_range_m=sigma[1])
    xy = measured.xy.T
    beyond = int(np.count_nonzero(~np.isfinite(xy).all(axis=1)))
    if beyond:
        raise DegenerateGeometryError(
            f"{beyond} matches lie outside the field of the lens and 'linear' uses all matches; remove them or use "
            "'robust'"
        )
    pose = linear_pose(matches.points, xy)
    state, seen = adjust_ranges(measured, States.of([pose], measured))
    fit = Fit(Evaluation(measured, state, seen), seen.s[0] <= options.gate_chi2, seen.s[0], True)
    root = np.sqrt(matches.weights)
    covariance = linear_covariance(
        pose, matches.points, matches.rays, xy,
        sigma_xy=sigma[0] / camera.focal_px / root, sigma_range_m=sigma[1] / root, seed=options.seed,
    )  # fmt: skip
    return build_result(fit, matches, camera, options, covariance, sigma, {"stopped": "closed form"})


def _solve_simplex(matches: Matches, camera: Camera, options: PoseOptions, initial: Rigid | None) -> PoseResult:
    residual: Residual = "stereo" if options.method == "stereo_simplex" else "epipolar"
    how = replace(options.simplex, residual=residual)
    found = fit_simplex(matches, camera, how, initial=initial, sigma_px=options.sigma_px or STATED_SIGMA_PX)
    return build_simplex_result(found, matches, camera, options)


_METHODS: Mapping[Method, Callable[[Matches, Camera, PoseOptions, Rigid | None], PoseResult]] = {
    "linear": _solve_linear,
    "stereo_simplex": _solve_simplex,
    "epipolar_simplex": _solve_simplex,
}
"""The solver of each method."""
