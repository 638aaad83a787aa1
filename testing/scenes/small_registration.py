"""A small registration with every case that exports must handle."""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import Registration
from ladarreg_core.results.steps import Step
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

CAMERA = Camera(120, 90, 100.0, 101.0, 59.0, 45.0, (0.1, -0.02, 0.0, 0.001))
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.05, -0.4, 0.02))


def sample_scan() -> Scan:
    geometry = AzimuthElevation(30, 44, 0.02, 0.02)
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[10:20, 15:30] = 2.5 / geometry.rays[10:20, 15:30, 0]
    ranges[3:5, 3:6] = np.nan
    return Scan(geometry, ranges, np.random.default_rng(1).random(geometry.shape) * 900 + 100)


def sample_photo() -> Photo:
    v, u = np.mgrid[:90, :120]
    return Photo(np.stack([2 * u, 2 * v, 255 - u - v], axis=-1).astype(np.uint8), CAMERA)


def sample_registration(*, accepted: bool = True) -> Registration:
    rng = np.random.default_rng(2)
    count = 5
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    matches = Matches(rays, rng.uniform(1, 4, count), rng.uniform(0, 90, (count, 2)), tuple("abcde"))
    residuals = rng.normal(size=(count, 2))
    residuals[2] = np.nan
    return Registration(
        camera_from_scanner=POSE,
        camera=CAMERA,
        matches=matches,
        inliers=np.array([True, False, False, True, True]),
        residuals_px=residuals,
        residuals_m=rng.normal(size=count) * 0.01,
        stereo_depth_error_m=np.full(count, np.nan),
        covariance=np.diag([1e-14] * 3 + [1e-13] * 3),  # its rays are random, some nearly across the camera
        chi2_per_dof=float("nan"),
        sigma_px=0.7,
        sigma_range_m=0.015,
        accepted=accepted,
        evidence="image" if accepted else "none",
        reasons=("Die Größe stimmt: 5 matches agree.",),
        diagnostics={"planarity": np.float32(0.25), "worst": float("inf"), 3: (1, 2)},
        method="auto",
        steps=(Step("channels", 0.01), Step("climb", 0.2, matches, POSE, {"rounds": np.int64(3)})),
        options={"window_px": 11, "kinds": ("a", "b"), "none": None, "flag": np.bool_(True)},
        seed=7,
    )
