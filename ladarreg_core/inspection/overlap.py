"""How much of a photograph each of several scans of one place sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray

_MAX_CELLS, _MIN_CELLS = 192, 4
_POINTS_PER_CELL = 12
"""Of the scan with the most points in the photograph: then hardly a cell of what it sees is without any."""
_BEHIND, _BEHIND_M = 0.15, 0.3
"""A scan sees a cell whose nearest point is at most so much farther than that of all scans, by its distance and m."""


def seen_shares(camera: CameraModel, scans: Sequence[FloatArray]) -> list[float]:
    """Return the share of a photograph that each scan sees, 0 to 1.

    The photograph is divided into cells. What lies behind the surface that another scan has there does not count: a
    scan in the next room sees nothing of the photograph, though its points are in its field of view.

    Args:
        camera: of the photograph.
        scans: (N, 3) points of each scan in the camera's frame, m, spread evenly over its surface.
    """
    width, height = camera.width, camera.height
    seen: list[tuple[FloatArray, FloatArray]] = []
    for points in scans:
        uv = np.asarray(camera.project(points))
        depth = np.linalg.norm(points, axis=-1)
        inside = np.isfinite(uv).all(axis=-1) & (uv >= -0.5).all(axis=-1) & (uv < (width - 0.5, height - 0.5)).all(-1)
        seen.append((uv[inside] + 0.5, depth[inside]))
    most = max((len(depth) for _, depth in seen), default=0)
    cells = float(np.clip(most / _POINTS_PER_CELL, _MIN_CELLS, _MAX_CELLS))
    columns = max(1, round((cells * width / height) ** 0.5))
    rows = max(1, round(cells / columns))
    nearest = np.full((len(seen), rows * columns), np.inf)
    for of_scan, (uv, depth) in zip(nearest, seen, strict=True):
        column, row = (uv[:, 0] * columns / width).astype(np.intp), (uv[:, 1] * rows / height).astype(np.intp)
        np.minimum.at(of_scan, row * columns + column, depth)
    of_all = nearest.min(axis=0, initial=np.inf)
    sees = np.isfinite(nearest) & (nearest <= of_all * (1 + _BEHIND) + _BEHIND_M)
    return [float(share) for share in sees.mean(axis=1)]
