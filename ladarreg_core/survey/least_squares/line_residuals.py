"""How far lines that were drawn in photographs lie from where the adjustment puts them.

The residual of a drawn end is its signed distance from the image of the line, in pixels: from the pixel of the image
that lies nearest. This holds for every camera, also where the image of a straight line is curved.

Source: Taylor and Kriegman 1995, 'Structure and motion from line segments in multiple images' (distance of the ends
from the projected line).
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.survey.least_squares.problem import Matrix, Problem, projected, surface_distances

_STEPS = 4  # to the nearest pixel of the image of a line: the first guess errs by some per cent of the distance


def line_residuals(problem: Problem) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return the distances of the drawn ends from the images of their lines, observed minus predicted.

    Returns:
        residual (N, 2) px, of the first and the second end; derivatives of the *prediction* by the pose (N, 2, 6), the
        camera (N, 2, 4) and the line (N, 2, 4). NaN where an end shows a place behind the camera, or none.
    """
    lines, count = problem.lines, len(problem.lines.photo)
    residual, by_pose = np.full((count, 2), np.nan), np.full((count, 2, 6), np.nan)
    by_camera, by_line = np.zeros((count, 2, 4)), np.full((count, 2, 4), np.nan)
    across = lines.across
    for body in np.unique(lines.photo).tolist():
        rows = np.flatnonzero(lines.photo == body)
        of = lines.line[rows]
        ends, points = lines.uv[rows].reshape(-1, 2), np.repeat(lines.points[of], 2, axis=0)
        off, J, of_camera, by_point, at = _end_residuals(problem, body, ends, points)
        residual[rows], by_pose[rows] = off.reshape(-1, 2), J.reshape(-1, 2, 6)
        if of_camera.shape[1]:
            by_camera[rows] = of_camera.reshape(-1, 2, 4)
        by_axes = np.einsum("ni,nij->nj", by_point, np.repeat(across[of], 2, axis=0))
        by_line[rows] = np.concatenate([(1 - at) * by_axes, at * by_axes], axis=1).reshape(-1, 2, 4)
    return residual, by_pose, by_camera, by_line


def line_surface_residuals(problem: Problem) -> tuple[Matrix, Matrix, Matrix]:
    """Return how far lines lie before the surfaces of scans, and the derivatives.

    Returns:
        distance (K,) m; derivatives by the scanner's (w, c), (K, 6), and by the line, (K, 4).
    """
    lines = problem.lines
    ends, at = lines.points[lines.on_line], lines.at[:, None]
    points = ends[:, 0] + at * (ends[:, 1] - ends[:, 0])
    distance, by_scan, by_point = surface_distances(problem, lines.scan, points, lines.xyz, lines.normal)
    by_axes = np.einsum("ki,kij->kj", by_point, lines.across[lines.on_line])
    return distance, by_scan, np.concatenate([(1 - at) * by_axes, at * by_axes], axis=1)


def _end_residuals(
    problem: Problem, body: int, uv: Matrix, points: Matrix
) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return residuals (N,) of pixels (N, 2) to lines through points (N, 2, 3), derivatives, and the places (N, 1).

    The derivatives are those of a fixed place of the line: along the image of the line the nearest pixel does not move
    to first order, and the direction across it turns about the end.
    """
    camera, pose = problem.camera_of(body), problem.poses[body]
    along = points[:, 1] - points[:, 0]
    there, toward = pose @ points[:, 0], along @ pose.rotation.T
    at = nearest_to_rays(camera.unproject(uv), there, toward)
    for _ in range(_STEPS):
        shown, by_place = camera.project_with_jacobian(there + at[:, None] * toward)
        tangent = np.einsum("nij,nj->ni", by_place, toward)
        squared = np.einsum("ni,ni->n", tangent, tangent)
        with np.errstate(invalid="ignore", divide="ignore"):
            at = at + np.einsum("ni,ni->n", camera.difference(uv, shown), tangent) / squared
    shown, J, of_camera = projected(problem, body, points[:, 0] + at[:, None] * along)
    tangent = np.einsum("nij,nj->ni", -J[..., 3:], along)  # a point moves against the camera's centre
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    off = np.einsum("ni,ni->n", normal, camera.difference(uv, shown))
    by_pose, by_camera = (np.einsum("ni,nij->nj", normal, one) for one in (J, of_camera))
    off = np.where(_is_determined(off, by_pose), off, np.nan)
    return off, by_pose, by_camera, -by_pose[:, 3:], at[:, None]


def nearest_to_rays(rays: Matrix, there: Matrix, toward: Matrix) -> Matrix:
    """Return where lines (N,) meet the rays (N, 3) of pixels, laid into the planes of lines and camera; NaN: behind."""
    normal = np.cross(there, toward)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        inside = rays - np.einsum("ni,ni->n", rays, normal)[:, None] * normal
        at = -_triple(there, inside, normal) / _triple(toward, inside, normal)
        ahead = np.einsum("ni,ni->n", there + at[:, None] * toward, inside) > 0
    return np.where(ahead, at, np.nan)


def _triple(first: Matrix, second: Matrix, third: Matrix) -> Matrix:
    return np.asarray(np.einsum("ni,ni->n", np.cross(first, second), third))


def _is_determined(off: Matrix, by_pose: Matrix) -> BoolArray:
    return np.asarray(np.isfinite(off) & np.isfinite(by_pose).all(axis=1))
