"""How predicted pixels move with the pose."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid


def pose_jacobian(
    camera_from_scanner: Rigid, points_scanner: FloatArray, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Project points, with the derivative of the pixels by the pose.

    Args:
        camera_from_scanner: the pose.
        points_scanner: (N, 3), m.
        camera: intrinsics.

    Returns:
        uv (N, 2), pixels, and J (N, 2, 6) = d uv / d (w, c), with R_true = exp([w]x) R and c the shift of the camera
        centre in the scanner frame; NaN behind the camera.
    """
    p = camera_from_scanner @ np.asarray(points_scanner, dtype=np.float64)
    uv, d_uv = camera.project_with_jacobian(p)
    by_turn = np.zeros((*p.shape[:-1], 3, 3))  # d p / d w = -[p]x
    by_turn[..., 0, 1], by_turn[..., 0, 2] = p[..., 2], -p[..., 1]
    by_turn[..., 1, 0], by_turn[..., 1, 2] = -p[..., 2], p[..., 0]
    by_turn[..., 2, 0], by_turn[..., 2, 1] = p[..., 1], -p[..., 0]
    return uv, np.concatenate([d_uv @ by_turn, -d_uv @ camera_from_scanner.rotation], axis=-1)
