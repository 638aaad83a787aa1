"""Conversion of lens models that OpenCV cannot express exactly, with a bound on the error over the picture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import CameraError
from ladarreg_core.formats.cameras.camera_in_file import Lens, lens_camera

LARGEST_ERROR_PX = 0.01
"""Largest error of a conversion anywhere in the picture, px."""
_SAMPLES = 40
_RAYS = 60
_WIDEST_RAD = {"pinhole": np.deg2rad(80.0), "fisheye": np.deg2rad(110.0)}
Projection = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Maps points (N, 3), camera frame, to pixels (N, 2); NaN beyond the fold."""


def refitted(
    project: Projection, lens: Lens, width: int, height: int, matrix: tuple[float, float, float, float], what: str
) -> tuple[CameraModel, str]:
    """Return the OpenCV camera that projects as another model does, and a note with the largest error.

    The terms are fitted on one half of a dense set of rays and the error is measured on all of them. The principal
    point and the focal lengths are fitted as well.

    Args:
        project: the other model.
        lens: `pinhole` (up to 12 terms) or `fisheye` (4 terms).
        width: pixels.
        height: pixels.
        matrix: approximate fx, fy, cx, cy.
        what: names the terms that OpenCV does not have, for the error message.

    Raises:
        CameraError: if it is wrong by .01 px or more anywhere in the picture.
    """
    rays, uv = _seen(project, lens, width, height)
    if len(rays) < 50:
        raise CameraError(f"its distortion maps almost no ray into the picture of {width} x {height} pixels; check it")
    least = np.inf
    for count in (5, 8, 12) if lens == "pinhole" else (4,):  # more terms only where they are needed
        fitted, terms, fit_error = _fit(rays, uv, lens, np.array(matrix, dtype=np.float64), count)
        least = min(least, fit_error)
        if fit_error < LARGEST_ERROR_PX and (fitted[:2] > 0).all():
            camera = lens_camera(lens, width, height, fitted.tolist(), terms.tolist())
            error = float(np.nan_to_num(np.hypot(*(camera.project(rays) - uv).T), nan=np.inf).max())
            if error < LARGEST_ERROR_PX:
                return camera, f"{what} expressed in OpenCV's terms; the largest error in the picture is {error:.1g} px"
    raise CameraError(
        f"{what} cannot be expressed in OpenCV's terms: the best fit is off by {max(least, LARGEST_ERROR_PX):.2g} px, "
        f"and at most {LARGEST_ERROR_PX} are accepted; calibrate without, or export undistorted photographs"
    )


def _seen(project: Projection, lens: Lens, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rays (N, 3) that fall into the picture before the model first folds back, and their pixels (N, 2)."""
    theta = np.linspace(0, _WIDEST_RAD[lens], _RAYS * 10)
    found_rays, found_uv = [], []
    for turn in np.linspace(0, 2 * np.pi, _RAYS, endpoint=False):
        side = np.stack([np.cos(turn) * np.sin(theta), np.sin(turn) * np.sin(theta), np.cos(theta)], axis=-1)
        with np.errstate(all="ignore"):
            uv = project(side)
            radius = np.hypot(*(uv - uv[0]).T)
            risen = np.concatenate([[True], np.diff(radius) > 0])
        inside = (uv[:, 0] > -0.5) & (uv[:, 0] < width - 0.5) & (uv[:, 1] > -0.5) & (uv[:, 1] < height - 0.5)
        last = int(np.argmin(risen & inside)) if not (risen & inside).all() else len(theta)
        keep = np.unique(np.linspace(0, max(last - 1, 0), _SAMPLES).astype(int))
        found_rays.append(side[keep])
        found_uv.append(uv[keep])
    rays, uv = np.concatenate(found_rays), np.concatenate(found_uv)
    finite = np.isfinite(uv).all(axis=-1)
    return rays[finite], uv[finite]


def _fit(
    rays: NDArray[np.float64], uv: NDArray[np.float64], lens: Lens, guess: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return fx, fy, cx, cy and the terms of the least-squares fit, and its largest error, px.

    Every second ray is fitted and the error is that of all, so that a fit that only meets its own samples is noticed.
    """
    from scipy.optimize import least_squares

    model = _pinhole if lens == "pinhole" else _fisheye

    def errors(x: NDArray[np.float64], step: int) -> NDArray[np.float64]:
        fx, fy, cx, cy = x[:4] * guess[0] + guess
        with np.errstate(all="ignore"):
            a, b = model(rays[::step], np.concatenate([x[4:], np.zeros(12 - count)]))
            error = np.stack([a * fx + cx - uv[::step, 0], b * fy + cy - uv[::step, 1]])
        return np.asarray(np.nan_to_num(error, nan=1e6, posinf=1e6, neginf=-1e6), dtype=np.float64)

    found = least_squares(
        lambda x: errors(x, 2).ravel(), np.zeros(4 + count), x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15,
        max_nfev=200,
    )  # fmt: skip
    x = np.asarray(found.x, dtype=np.float64)
    return x[:4] * guess[0] + guess, x[4:], float(np.hypot(*errors(x, 1)).max())


def _pinhole(rays: NDArray[np.float64], k: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = k
    s = x * x + y * y
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s * (s1 + s * s2)
    return xd, y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s * (s3 + s * s4)


def _fisheye(rays: NDArray[np.float64], k: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(r, rays[:, 2])
    s = theta * theta
    mapped = theta * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    scale = mapped / np.where(r > 1e-12, r, 1.0)
    return rays[:, 0] * scale, rays[:, 1] * scale
