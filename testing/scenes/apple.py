"""The apple: Table 3.1 of the thesis in three readings.

"Radius one" contradicts "ranges from two to eight", hence three: A has radius 1 and depth 4 to 6 at f = 256 px, B
radius 3 and depth 2 to 8 at f = 128 px, C radius 3 at f = 256 px with all spikes +-3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters
from ladarreg_core.thesis.estimators.stereo_simplex import Residual, SimplexOptions, fit_simplex
from testing.scenes.accuracy import Solver
from testing.scenes.pose_case import Case

APPLE_TRUTH = ThesisParameters(5.0, 2.0, 2.0, *np.deg2rad([25.0, 10.0, 5.0]))
APPLE_READINGS = {"A": (1.0, 256.0, False), "B": (3.0, 128.0, False), "C": (3.0, 256.0, True)}
"""Radius, focal length in px, and whether the spikes are all of 3 units."""
THESIS_START = ThesisParameters(2.0, 0.0, 0.0, 0.0, 0.0, 0.0).pose
"""'Two meter translation', and no rotation: the start of thesis 3.2."""


def apple_points(reading: str) -> np.ndarray:
    """Return the 208 vertices of the apple, scanner frame."""
    radius, _, _ = APPLE_READINGS[reading]
    t, phi = (
        a.ravel() for a in np.meshgrid(np.linspace(0.12, np.pi - 0.12, 13), np.arange(16) * np.pi / 8, indexing="ij")
    )
    rho = (1 - 0.35 * np.exp(-((t / 0.45) ** 2)) - 0.2 * np.exp(-(((np.pi - t) / 0.4) ** 2))) * (1 + 0.08 * np.cos(t))
    rho /= np.abs(rho * np.sin(t)).max()
    apple = np.column_stack([rho * np.sin(t) * np.cos(phi), -rho * np.cos(t), rho * np.sin(t) * np.sin(phi)])
    c, s = np.cos(0.35), np.sin(0.35)
    apple = apple @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T * radius + [0, 0, 5]
    return apple @ CAMERA_AXES_FROM_SCANNER


def apple_case(reading: str, seed: int) -> Case:
    """Return the case of Table 3.1: 208 vertices, uniform noise on ranges and pixels, spikes on a tenth of the
    ranges."""
    _, focal, fixed_spikes = APPLE_READINGS[reading]
    rng = np.random.default_rng([seed, ord(reading)])
    points = apple_points(reading)
    ranges = np.linalg.norm(points, axis=1)
    rays = points / ranges[:, None]
    camera = Camera(512, 512, focal, focal, 255.5, 255.5)
    n = len(points)
    uv = np.rint(camera.project(APPLE_TRUTH.pose @ points) + rng.uniform(-3, 3, (n, 2)))
    spike = rng.permutation(n) < round(n / 10)
    height = np.where(rng.random(n) < 0.5, -1.0, 1.0) * (3.0 if fixed_spikes else rng.uniform(0, 3, n))
    ranges = ranges + rng.uniform(-0.25, 0.25, n) + spike * height
    return Case(
        rays,
        np.maximum(ranges, 0.05),
        uv,
        camera,
        APPLE_TRUTH.pose,
        ~spike,
        float(np.sqrt(3 + 1 / 12)),
        0.25 / np.sqrt(3),
    )


def apple_error_percent(pose: Rigid) -> float:
    """Return the mean |error| over the six parameters, per cent of each."""
    found, truth = ThesisParameters.from_pose(pose), APPLE_TRUTH
    names = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
    return 100 * float(np.mean([abs(getattr(found, k) / getattr(truth, k) - 1) for k in names]))


def simplex_poses(
    case: Case,
    residual: Residual,
    *,
    start: Rigid | None = THESIS_START,
    threshold_m: float | None = None,
    restarts: int = 2,
) -> tuple[Rigid, Rigid]:
    """Return the poses of the simplex before and after rejection; threshold None: from the data."""
    options = SimplexOptions(residual=residual, reject_depth_m=threshold_m, restarts=restarts)
    fit = fit_simplex(case.matches, case.camera, options, initial=start, sigma_px=case.sigma_px)
    return fit.before.camera_from_scanner, fit.after.camera_from_scanner


def simplex_apple_figures(
    residual: Residual, reading: str, seeds: Sequence[int], threshold: float | None
) -> np.ndarray:
    """Return the mean |error| % of every seed, (N, 2): all points, outliers rejected."""
    errors = []
    for seed in seeds:
        poses = simplex_poses(apple_case(reading, seed), residual, threshold_m=threshold)
        errors.append([apple_error_percent(pose) for pose in poses])
    return np.array(errors)


def apple_errors(solver: Solver, reading: str, seeds: Sequence[int]) -> np.ndarray:
    """Return the mean |error| % of every seed (N,); infinite where there is no pose."""
    found = [solver(apple_case(reading, seed)) for seed in seeds]
    return np.array([apple_error_percent(f[0]) if f else np.inf for f in found])


def apple_figures(solver: Solver, reading: str, seeds: int) -> tuple[float, float]:
    """Return median and 95th percentile of the mean |error| % over seeds."""
    return median_and_p95(apple_errors(solver, reading, range(seeds)))


def median_and_p95(errors: np.ndarray) -> tuple[float, float]:
    how = "linear" if np.isfinite(errors).all() else "higher"  # no interpolation between a number and infinity
    return float(np.median(errors)), float(np.percentile(errors, 95, method=how))  # type: ignore[call-overload]
