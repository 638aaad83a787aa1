"""Which of the matcher's points the photo's camera can see: a coarse z-buffer of the scan's own cloud.

For matching only; the texture uses the exact surface (`ladarreg_core.visibility`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.levels import ScanLevels

_CLOUD_STEP = 2
_BUFFER_SCALE = 0.25
_TOLERANCE_FRACTION = 0.04
_TOLERANCE_M = 0.02


class Occluder:
    """The scan's cloud at half resolution, ready to be splatted into any pose's z-buffer."""

    def __init__(self, scan: ScanLevels, photo_camera: Camera) -> None:
        ranges = scan.ranges[::_CLOUD_STEP, ::_CLOUD_STEP]
        v, u = np.nonzero(np.isfinite(ranges))
        uv = np.stack([u, v], axis=-1) * float(_CLOUD_STEP)
        rays = scan.view.camera.unproject(uv) @ scan.view.view_from_scanner.rotation
        self._cloud = (rays * ranges[v, u][:, None]).astype(np.float32)
        self._camera = photo_camera.scaled(_BUFFER_SCALE)

    def depth_buffer(self, camera_from_scanner: Rigid) -> FloatArray:
        """Return the nearest depth per coarse pixel, (h, w) float32 m; infinite where nothing is."""
        cloud = camera_from_scanner @ self._cloud
        cell, inside = self._cells(cloud)
        buffer = np.full(self._camera.width * self._camera.height, np.inf, np.float32)
        np.minimum.at(buffer, cell[inside], cloud[inside, 2])
        return buffer

    def visible(self, points_camera: FloatArray, buffer: FloatArray) -> BoolArray:
        """Return which points (N, 3), camera frame, lie in the picture and on its nearest surface."""
        cell, inside = self._cells(points_camera)
        depth = points_camera[:, 2]
        nearest = buffer[np.where(inside, cell, 0)]
        return np.asarray(inside & (depth <= nearest * (1 + _TOLERANCE_FRACTION) + _TOLERANCE_M))

    def _cells(self, points_camera: FloatArray) -> tuple[NDArray[np.intp], BoolArray]:
        camera = self._camera
        x, y, z = points_camera[:, 0], points_camera[:, 1], points_camera[:, 2]
        front = z > 0.05
        safe = np.where(front, z, 1)
        u = np.rint(np.clip(x / safe * camera.fx + camera.cx, -1e6, 1e6)).astype(np.intp)
        v = np.rint(np.clip(y / safe * camera.fy + camera.cy, -1e6, 1e6)).astype(np.intp)
        inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        return v * camera.width + u, inside
