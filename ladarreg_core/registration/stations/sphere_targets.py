"""The centre of a survey sphere in a scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.foundations.validation import require_positive, require_type
from ladarreg_core.registration.stations.survey_target import SurveyTarget, picked_cell
from ladarreg_core.scan import Scan

_MIN_CELLS = 12  # on the face of a sphere
_MAX_INCIDENCE_COS = 0.5  # cells that the beam meets more obliquely than 60 degrees are mixed with what is behind
_OUTLIER_SIGMAS = 4.0
_MIN_SHARE = 0.7  # of the cells on its face that fit
_MAX_RMS_SHARE = 0.1  # of the radius: a flat surface is further from any sphere
_RADIUS_SHARE, _RADIUS_SIGMAS = 0.1, 4.0  # by which the radius may differ if it were free, the larger of both
_ROUNDS = 30
_MAX_START_POINTS = 500


def fit_sphere(scan: Scan, pick: tuple[int, int], *, radius_m: float) -> SurveyTarget:
    """Fit a sphere of known radius to the cells around a pick.

    The ranges are compared with those at which each ray meets the sphere, so that a sphere seen from one side only is
    not drawn toward the scanner. Which cells are used follows from their rays and not from their ranges; the rim, where
    a beam also meets what is behind, is left out.

    Args:
        scan: the scan.
        pick: row and column of a cell on the sphere.
        radius_m: radius of the sphere, m.

    Returns:
        the center with its covariance, from the scatter of the ranges about the sphere.

    Raises:
        OptionError: if an argument is of a wrong type, or the pick is outside of the scan.
        DegenerateGeometryError: if the pick has no return, or there is no sphere of this radius around it.
    """
    require_type(scan, Scan, "the scan")
    radius = _radius(radius_m)
    row, column = picked_cell(scan, pick)
    if not scan.valid[row, column]:
        raise DegenerateGeometryError(f"row {row}, column {column} has no return; pick a cell on the sphere")
    rays, ranges = scan.rays[row, column].astype(np.float64), scan.ranges.astype(np.float64)
    front = rays * ranges[row, column]
    # The sphere is within two radii of any point on it.
    reach = np.arcsin(min(1.0, 2.2 * radius / max(ranges[row, column], 2.2 * radius)))
    near = (scan.rays @ rays.astype(scan.rays.dtype) >= np.cos(reach)) & scan.valid
    d, r = scan.rays[near].astype(np.float64), ranges[near]
    center = _start(d * r[:, None], front, rays, radius)
    sigma, kept = np.inf, np.zeros(len(d), bool)
    for _ in range(_ROUNDS):
        face, residual, jacobian = _compared(d, r, center, radius)
        if np.count_nonzero(face) < _MIN_CELLS:
            raise DegenerateGeometryError(_too_few(int(np.count_nonzero(face)), row, column))
        sigma = max(1.4826 * float(np.median(np.abs(residual[face]))), 1e-6)
        kept = face & (np.abs(residual) < _OUTLIER_SIGMAS * sigma)
        step = np.linalg.lstsq(jacobian[kept], residual[kept], rcond=None)[0]
        center = center + step * min(1.0, 0.3 * radius / max(float(np.linalg.norm(step)), 1e-12))
        if np.linalg.norm(step) < 1e-3 * sigma:
            break
    face, residual, jacobian = _compared(d, r, center, radius)
    kept = face & (np.abs(residual) < _OUTLIER_SIGMAS * sigma)
    count = int(np.count_nonzero(kept))
    if count < _MIN_CELLS:
        raise DegenerateGeometryError(_too_few(count, row, column))
    rms = float(np.sqrt(np.mean(residual[kept] ** 2)))
    variance = rms**2 * count / (count - 3)
    _check_shape(d[kept], residual[kept], jacobian[kept], center, radius, variance, count / np.count_nonzero(face))
    if np.linalg.norm(front - center) > radius + max(0.3 * radius, 6 * rms):
        raise DegenerateGeometryError(
            f"the sphere nearest to row {row}, column {column} does not reach that cell; pick a cell on the sphere"
        )
    covariance = np.asarray(variance * np.linalg.inv(jacobian[kept].T @ jacobian[kept]), np.float64)
    return SurveyTarget(
        np.asarray(center, np.float64), covariance, radius, rms, count, int(np.count_nonzero(face)) - count
    )


def _radius(radius_m: float) -> float:
    """Return a radius as float; raise `OptionError` unless it is positive and at most 5 m."""
    require_positive(radius_m, "radius_m", most=5.0)
    return float(radius_m)


def _start(
    points: NDArray[np.float64], front: NDArray[np.float64], ray: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """Return the center (3,) that the points near a pick agree on, from their distances to the sphere."""
    from scipy.optimize import least_squares

    close = points[np.linalg.norm(points - front, axis=1) < 2 * radius]
    close = close[:: -(-len(close) // _MAX_START_POINTS)]

    def toward(center: NDArray[np.float64]) -> NDArray[np.float64]:
        away = center - close
        return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), 1e-12)[:, None])

    found = least_squares(
        lambda center: np.linalg.norm(close - center, axis=1) - radius,
        front + radius * ray, toward, loss="cauchy", f_scale=0.05 * radius, max_nfev=100,
    )  # fmt: skip
    return np.asarray(found.x, np.float64)


def _compared(
    d: NDArray[np.float64], r: NDArray[np.float64], center: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return which rays (N,) meet the sphere well inside its rim, measured less expected ranges, and their
    derivatives (N, 3) by the center.
    """
    along = d @ center
    inside = along**2 - center @ center + radius**2
    face = (inside > (_MAX_INCIDENCE_COS * radius) ** 2) & (along > 0)
    root = np.sqrt(np.where(face, inside, 1.0))
    expected = along - root
    jacobian = d - (along[:, None] * d - center) / root[:, None]
    return face, np.where(face, r - expected, np.inf), jacobian


def _check_shape(
    d: NDArray[np.float64], residual: NDArray[np.float64], jacobian: NDArray[np.float64], center: NDArray[np.float64],
    radius: float, variance: float, share: float,
) -> None:  # fmt: skip
    """Raise `DegenerateGeometryError` unless the cells lie on a sphere of the radius given."""
    advice = "pick a cell on the sphere, or correct its radius"
    if share < _MIN_SHARE or variance > (_MAX_RMS_SHARE * radius) ** 2:
        raise DegenerateGeometryError(
            f"there is no sphere of radius {format_length(radius)} around the pick: {share:.0%} of the cells fit one, "
            f"to {format_length(float(np.sqrt(variance)))}; {advice}"
        )
    root = np.sqrt((d @ center) ** 2 - center @ center + radius**2)
    free = np.column_stack([jacobian, -radius / root])
    step = np.linalg.lstsq(free, residual, rcond=None)[0][3]
    sigma = float(np.sqrt(variance * np.linalg.inv(free.T @ free)[3, 3]))
    if abs(step) > max(_RADIUS_SHARE * radius, _RADIUS_SIGMAS * sigma):
        raise DegenerateGeometryError(
            f"the surface around the pick has a radius of about {format_length(max(radius + step, 0.0))}, not of "
            f"{format_length(radius)}; {advice}"
        )


def _too_few(count: int, row: int, column: int) -> str:
    return (
        f"{count} cells around row {row}, column {column} are on the sphere; at least {_MIN_CELLS} are needed: scan it "
        "more finely or from nearer, or pick a cell on the sphere"
    )
