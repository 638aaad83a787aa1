"""The thesis's linear method: eight unknowns by SVD, then the third row of the rotation and the last translation.

Exact for exact matches; with noise it serves as a starting pose. Image coordinates are not normalised: normalisation
gave worse poses.

Source: thesis 2.4.1, Eq 2.10, with the sign of the back-substitution corrected (least squares over all matches).
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, principal_extents, rotvec_from_rotation

MIN_MATCHES = 7
MIN_PLANARITY = 0.3
"""Smallest relief of the points: on a plane the median error is 5 m, with 30 cm of relief 52 mm."""


def linear_pose(points_scanner: FloatArray, xy: FloatArray) -> Rigid:
    """Return the pose that solves the radial constraints of all matches.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        xy: (N, 2) undistorted image coordinates, tangents.

    Returns:
        camera_from_scanner.

    Raises:
        DegenerateGeometryError: with fewer than 7 matches, with points too close to a plane (smallest singular value
            of the centred points below 0.3 of the middle one), or if the constraints have more than one solution.
    """
    count = len(points_scanner)
    if count < MIN_MATCHES:
        raise DegenerateGeometryError(
            f"the linear method got {count} matches and needs {MIN_MATCHES}; add matches or use 'robust'"
        )
    s = principal_extents(points_scanner)
    if s[2] < MIN_PLANARITY * s[1]:
        raise DegenerateGeometryError(
            f"the matches are too close to a plane for the linear method (relief {s[2] / max(s[1], 1e-300):.2g} of "
            f"their width, at least {MIN_PLANARITY:g} is needed); add matches off the plane or use 'robust'"
        )
    rotation, translation, determined = solve_radial(points_scanner[None], xy[None])
    if not determined[0]:
        raise DegenerateGeometryError(
            "the equations of the linear method have more than one solution; spread the matches over the photo or use "
            "'robust'"
        )
    return Rigid(rotation[0], translation[0])


def solve_radial(points: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Solve B sets of radial constraints x (r2 . X + Ty) = y (r1 . X + Tx).

    Args:
        points: (B, N, 3), scanner frame, m.
        xy: (B, N, 2) tangents.

    Returns:
        Rotations (B, 3, 3), translations (B, 3), and which sets have a unique solution (B,) bool.
    """
    x, y = xy[..., :1], xy[..., 1:]
    A = np.concatenate([-y * points, x * points, -y, x], axis=-1)  # unknowns r1, r2, Tx, Ty
    missing = max(0, 8 - A.shape[1])  # with seven matches, rows of zeros yield the null vector
    A = np.concatenate([A, np.zeros((len(A), missing, 8))], axis=1)
    _, singular, vt = np.linalg.svd(A, full_matrices=False)
    v = vt[:, -1]
    # the null vector must be separated from the next one; with few matches that one is of the size of the noise
    determined = singular[:, 6] > 1e-9 * singular[:, 0]
    length = np.sqrt(np.linalg.norm(v[:, :3], axis=1) * np.linalg.norm(v[:, 3:6], axis=1))
    determined &= length > 1e-12
    v = v / np.maximum(length, 1e-300)[:, None]
    X = points @ v[:, :3, None] + v[:, None, 6:7]
    Y = points @ v[:, 3:6, None] + v[:, None, 7:8]
    sign = np.where((x * X + y * Y).sum(axis=(1, 2)) >= 0, 1.0, -1.0)  # the signs agree in front of the camera
    v = v * sign[:, None]
    r1, r2 = v[:, :3], v[:, 3:6]
    U, _, Vt = np.linalg.svd(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    proper = np.linalg.det(U @ Vt) > 0
    R = U @ Vt
    determined &= proper
    rotated = points @ R.swapaxes(1, 2)
    X, Y, Z = rotated[..., :1] + v[:, None, 6:7], rotated[..., 1:2] + v[:, None, 7:8], rotated[..., 2:]
    # x (Z + Tz) = X and y (Z + Tz) = Y of every match
    top = (x * (X - x * Z) + y * (Y - y * Z)).sum(axis=(1, 2))
    bottom = (x * x + y * y).sum(axis=(1, 2))
    determined &= bottom > 0
    Tz = top / np.maximum(bottom, 1e-300)
    return R, np.column_stack([v[:, 6], v[:, 7], Tz]), np.asarray(determined)


def linear_covariance(
    pose: Rigid,
    points_scanner: FloatArray,
    rays_scanner: FloatArray,
    xy: FloatArray,
    *,
    sigma_xy: FloatArray,
    sigma_range_m: FloatArray,
    seed: int,
    draws: int = 100,
) -> FloatArray:
    """Return the covariance (6, 6) of (w, c) by Monte Carlo, since the method is far from efficient.

    Args:
        pose: the linear pose.
        points_scanner: (N, 3) m.
        rays_scanner: (N, 3) unit.
        xy: (N, 2) tangents.
        sigma_xy: (N,) noise of `xy`, tangents.
        sigma_range_m: (N,) m.
        seed: random seed.
        draws: number of draws.
    """
    rng = np.random.default_rng(seed)
    n = len(points_scanner)
    noisy = points_scanner + rays_scanner * (sigma_range_m[:, None] * rng.standard_normal((draws, n, 1)))
    R, t, determined = solve_radial(noisy, xy + sigma_xy[:, None] * rng.standard_normal((draws, n, 2)))
    R, t = R[determined], t[determined]
    if len(R) < draws // 2:
        return np.diag([np.pi**2] * 3 + [float(np.abs(points_scanner).max()) ** 2] * 3)
    rotvecs = np.stack([rotvec_from_rotation(r @ pose.rotation.T) for r in R])
    centres = -(R.swapaxes(1, 2) @ t[..., None])[..., 0]
    step = np.column_stack([rotvecs, centres - pose.centre])
    return np.asarray(step.T @ step / len(step))
