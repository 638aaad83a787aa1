"""The thesis's linear method: eight unknowns at once, then the third row and the last component.

Exact where the matches are; with noise it is the start for something better. Picture coordinates are used as they are:
normalising them gave worse poses.

Source: thesis 2.4.1, Eq 2.10, with the sign of the back-substitution corrected (least squares over all matches).
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid, principal_extents, rotvec_from_rotation

LEAST_MATCHES = 7
LEAST_PLANARITY = 0.3
"""On a plane the median error is 5 m, with 30 cm of relief 52 mm; range noise alone never makes it exactly 0."""


def linear_pose(points_scanner: FloatArray, xy: FloatArray) -> Rigid:
    """Return the pose that solves the radial constraints of all matches.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        xy: (N, 2) ideal picture coordinates, tangents.

    Returns:
        camera_from_scanner.

    Raises:
        DegenerateGeometryError: with fewer than 7 matches, with points too near a plane (the centred points' least
            singular value below 0.3 of the middle one), or where the constraints leave more than one solution.
    """
    count = len(points_scanner)
    if count < LEAST_MATCHES:
        raise DegenerateGeometryError(
            f"the linear method got {count} matches and needs {LEAST_MATCHES}; add matches or use 'robust'"
        )
    s = principal_extents(points_scanner)
    if s[2] < LEAST_PLANARITY * s[1]:
        raise DegenerateGeometryError(
            f"the matches lie too near a plane for the linear method (relief {s[2] / max(s[1], 1e-300):.2g} of their "
            f"width, at least {LEAST_PLANARITY:g} is needed); add matches off the plane or use 'robust'"
        )
    rotation, translation, determined = solve_radial(points_scanner[None], xy[None])
    if not determined[0]:
        raise DegenerateGeometryError(
            "the linear method's equations leave more than one solution; spread the matches over the picture or use "
            "'robust'"
        )
    return Rigid(rotation[0], translation[0])


def solve_radial(points: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Solve B sets of radial constraints x (r2 . X + Ty) = y (r1 . X + Tx).

    Args:
        points: (B, N, 3), scanner frame, m.
        xy: (B, N, 2) tangents.

    Returns:
        Rotations (B, 3, 3), translations (B, 3), and which have one solution (B,) bool.
    """
    x, y = xy[..., :1], xy[..., 1:]
    A = np.concatenate([-y * points, x * points, -y, x], axis=-1)  # unknowns r1, r2, Tx, Ty
    missing = max(0, 8 - A.shape[1])  # seven matches leave the null vector to a row of zeros
    A = np.concatenate([A, np.zeros((len(A), missing, 8))], axis=1)
    _, singular, vt = np.linalg.svd(A, full_matrices=False)
    v = vt[:, -1]
    # The null vector must stand clear of the next one, which on few matches is also the noise's own size.
    determined = singular[:, 6] > 1e-9 * singular[:, 0]
    length = np.sqrt(np.linalg.norm(v[:, :3], axis=1) * np.linalg.norm(v[:, 3:6], axis=1))
    determined &= length > 1e-12
    v = v / np.maximum(length, 1e-300)[:, None]
    X = points @ v[:, :3, None] + v[:, None, 6:7]
    Y = points @ v[:, 3:6, None] + v[:, None, 7:8]
    sign = np.where((x * X + y * Y).sum(axis=(1, 2)) >= 0, 1.0, -1.0)  # in front of the camera both agree in sign
    v = v * sign[:, None]
    r1, r2 = v[:, :3], v[:, 3:6]
    U, _, Vt = np.linalg.svd(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    proper = np.linalg.det(U @ Vt) > 0
    R = U @ Vt
    determined &= proper
    turned = points @ R.swapaxes(1, 2)
    X, Y, Z = turned[..., :1] + v[:, None, 6:7], turned[..., 1:2] + v[:, None, 7:8], turned[..., 2:]
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
    """Return the covariance (6, 6) of (w, c) by drawing the noise again: the method is far from efficient.

    Args:
        pose: the linear pose.
        points_scanner: (N, 3) m.
        rays_scanner: (N, 3) unit.
        xy: (N, 2) tangents.
        sigma_xy: (N,) noise of `xy`.
        sigma_range_m: (N,) m.
        seed: of the draws.
        draws: how many.
    """
    rng = np.random.default_rng(seed)
    n = len(points_scanner)
    shaken = points_scanner + rays_scanner * (sigma_range_m[:, None] * rng.standard_normal((draws, n, 1)))
    R, t, determined = solve_radial(shaken, xy + sigma_xy[:, None] * rng.standard_normal((draws, n, 2)))
    R, t = R[determined], t[determined]
    if len(R) < draws // 2:
        return np.diag([np.pi**2] * 3 + [float(np.abs(points_scanner).max()) ** 2] * 3)
    turns = np.stack([rotvec_from_rotation(r @ pose.rotation.T) for r in R])
    centres = -(R.swapaxes(1, 2) @ t[..., None])[..., 0]
    step = np.column_stack([turns, centres - pose.centre])
    return np.asarray(step.T @ step / len(step))
