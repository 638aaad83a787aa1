"""From matches to a pose that explains itself, by the default estimator or by one of the thesis's."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.arrays import read_only
from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import Measurements, States, settle
from ladarreg_core.pose.checks import checked_matches
from ladarreg_core.pose.intrinsics import Intrinsics
from ladarreg_core.pose.options import STATED_SIGMA_PX as STATED_SIGMA_PX
from ladarreg_core.pose.options import STATED_SIGMA_RANGE_M as STATED_SIGMA_RANGE_M
from ladarreg_core.pose.options import Method as Method
from ladarreg_core.pose.options import PoseOptions as PoseOptions
from ladarreg_core.pose.result import Fit, answer
from ladarreg_core.pose.robust import solve_robust
from ladarreg_core.pose.simplex_result import simplex_answer
from ladarreg_core.pose.thesis.linear import linear_covariance, linear_pose
from ladarreg_core.pose.thesis.stereo_simplex import Residual, fit_simplex
from ladarreg_core.results import PoseResult


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
    intrinsics: Intrinsics | Literal["auto"] = "auto",
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
        intrinsics: what of the camera `robust` estimates too: `fixed` (nothing), `focal`, `focal_k1`,
            `focal_k1_centre`, or `auto`: the focal length, then k1, where matches that are held out become clearly
            more likely by it.
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
    options = PoseOptions(
        method=method, sigma_px=sigma_px, sigma_range_m=sigma_range_m, intrinsics=intrinsics, seed=seed
    )
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
    return solve_robust(matches, camera, options, initial=initial)


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
    fit = Fit(measured, state, seen.s[0] <= options.gate_chi2, seen.s[0], True)
    assert matches.weights is not None
    root = np.sqrt(matches.weights)
    covariance = linear_covariance(
        pose, matches.points, matches.rays, xy,
        sigma_xy=sigma[0] / camera.focal_px / root, sigma_range_m=sigma[1] / root, seed=options.seed,
    )  # fmt: skip
    return answer(fit, matches, camera, options, covariance, sigma, {"stopped": "closed form"})


def _solve_simplex(matches: Matches, camera: Camera, options: PoseOptions, initial: Rigid | None) -> PoseResult:
    residual: Residual = "stereo" if options.method == "stereo_simplex" else "epipolar"
    how = replace(options.simplex, residual=residual)
    found = fit_simplex(matches, camera, how, initial=initial, sigma_px=options.sigma_px or STATED_SIGMA_PX)
    return simplex_answer(found, matches, camera, options)
