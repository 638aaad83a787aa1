"""Where a pose puts what was picked in one picture into the other."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import measured_ranges
from ladarreg_core.surface.visibility import ScanProjection, project_scan

_REACH_PX = 6
_REFINED_CELLS = 1.5


class Partners:
    """Partners under one pose; what both directions need is made once."""

    def __init__(self, scan: Scan, camera: Camera, camera_from_scanner: Rigid) -> None:
        self._scan = scan
        self._camera = camera
        self._pose = camera_from_scanner

    def in_photo(self, rays: ArrayLike) -> FloatArray:
        """Return the photo pixels (N, 2) of unit rays (N, 3), scanner frame.

        NaN where the scan has no return along the ray, or the camera does not look there. At a depth edge the nearer
        surface counts.
        """
        directions = np.asarray(rays, dtype=np.float64)
        ranges = measured_ranges(self._scan, directions).outline
        uv = self._camera.project(self._pose @ (directions * ranges[:, None]))
        return np.where(self._camera.contains(uv)[:, None], uv, np.nan)

    def on_scan(self, uv: ArrayLike) -> FloatArray:
        """Return the unit rays (N, 3), scanner frame, of what the camera sees at photo pixels (N, 2).

        NaN where it sees no surface of the scan within 6 px.
        """
        return np.array([self._ray_at(np.asarray(at, dtype=np.float64)) for at in np.asarray(uv)]).reshape(-1, 3)

    @cached_property
    def _projection(self) -> ScanProjection:
        return project_scan(self._scan, self._camera, self._pose)

    @cached_property
    def _nearest_cell(self) -> NDArray[np.int32]:
        """Which visible cell lies in each pixel of the photo, by flat index; -1: none. The nearest counts."""
        projection = self._projection
        seen = np.flatnonzero(projection.visible)
        seen = seen[np.argsort(-projection.depth_m.reshape(-1)[seen], kind="stable")]  # the last one written stays
        at = np.rint(projection.uv.reshape(-1, 2)[seen]).astype(np.intp)
        grid = np.full((self._camera.height, self._camera.width), -1, np.int32)
        u, v = np.clip(at[:, 0], 0, self._camera.width - 1), np.clip(at[:, 1], 0, self._camera.height - 1)
        grid[v, u] = seen
        return grid

    def _ray_at(self, at: FloatArray) -> FloatArray:
        nowhere = np.full(3, np.nan)
        if not np.isfinite(at).all() or not self._camera.contains(at):
            return nowhere
        u, v = np.rint(at).astype(int)
        around = self._nearest_cell[
            max(v - _REACH_PX, 0) : v + _REACH_PX + 1, max(u - _REACH_PX, 0) : u + _REACH_PX + 1
        ]
        cells = np.unique(around[around >= 0])
        if not len(cells):
            return nowhere
        uv = self._projection.uv.reshape(-1, 2)[cells].astype(np.float64)
        away = np.linalg.norm(uv - at, axis=1)
        best = int(np.argmin(away))
        if away[best] > _REACH_PX:
            return nowhere
        cell = np.array(divmod(int(cells[best]), self._scan.shape[1]), dtype=np.float64)
        return np.asarray(self._scan.geometry.ray_at((cell + self._rest(cell, at - uv[best]))[None])[0])

    def _rest(self, cell: FloatArray, missing: FloatArray) -> FloatArray:
        """Return how far beside a cell's centre a pixel is met, in cells, by the slope of the surface around it."""
        row, column = cell.astype(int)
        height, width = self._scan.shape
        uv = self._projection.uv
        r0, r1, c0, c1 = max(row - 1, 0), min(row + 1, height - 1), max(column - 1, 0), min(column + 1, width - 1)
        J = np.stack([(uv[r1, column] - uv[r0, column]) / (r1 - r0), (uv[row, c1] - uv[row, c0]) / (c1 - c0)], axis=1)
        if not np.isfinite(J).all() or abs(np.linalg.det(J.astype(np.float64))) < 1e-6:
            return np.zeros(2)
        rest = np.linalg.solve(J.astype(np.float64), missing)
        return np.asarray(rest if np.abs(rest).max() <= _REFINED_CELLS else np.zeros(2))
