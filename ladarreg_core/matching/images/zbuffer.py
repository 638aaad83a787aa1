"""Visibility of scan points in the photo during matching, by a coarse z-buffer of the point cloud.

The texture uses the exact surface instead (`ladarreg_core.surface.visibility.visible_points`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.scan_levels import ScanLevels

_CLOUD_STEP = 2
_BUFFER_SCALE = 0.25
_TOLERANCE_FRACTION = 0.04
_TOLERANCE_M = 0.02
_NEAREST_M = 0.05


class Occluder:
    """Occlusion test by the scan's point cloud at half resolution, splatted into a z-buffer for each pose."""

    def __init__(self, scan: ScanLevels, photo_camera: Camera) -> None:
        ranges = scan.ranges[::_CLOUD_STEP, ::_CLOUD_STEP]
        v, u = np.nonzero(np.isfinite(ranges))
        uv = np.stack([u, v], axis=-1) * float(_CLOUD_STEP)
        rays = scan.view.camera.unproject(uv) @ scan.view.view_from_scanner.rotation
        # one row per coordinate: every pose splats the whole cloud, and rows are projected without copies
        self._cloud = np.ascontiguousarray((rays * ranges[v, u][:, None]).T, dtype=np.float32)
        self._camera = photo_camera.scaled(_BUFFER_SCALE)
        self._last: tuple[Rigid, FloatArray] | None = None

    def depth_buffer(self, camera_from_scanner: Rigid) -> FloatArray:
        """Return the nearest depth of each coarse pixel, (h w,) float32 m; infinite without points."""
        last = self._last  # read once: another thread may be working on another pose
        if last is not None and last[0] is camera_from_scanner:
            return last[1]  # the end of a refinement is used several times
        cloud = camera_from_scanner.rotation.astype(np.float32) @ self._cloud
        cloud += camera_from_scanner.translation.astype(np.float32)[:, None]
        cell, inside = self._cells(*cloud)
        buffer = np.full(self._camera.width * self._camera.height, np.inf, np.float32)
        np.minimum.at(buffer, cell, cloud[2][inside])
        self._last = camera_from_scanner, buffer
        return buffer

    def visible(self, points_camera: FloatArray, buffer: FloatArray) -> BoolArray:
        """Return a mask (N,) of the points (N, 3), camera frame, that lie in the image and on the nearest surface."""
        x, y, z = np.ascontiguousarray(points_camera.T)
        cell, inside = self._cells(x, y, z)
        shown = z[inside] <= buffer[cell] * (1 + _TOLERANCE_FRACTION) + _TOLERANCE_M
        visible = np.zeros(len(points_camera), np.bool_)
        visible[inside] = shown
        return visible

    def in_front(self, points_camera: FloatArray, buffer: FloatArray) -> BoolArray:
        """Return a mask (N,) of the points (N, 3), camera frame, that lie clearly before the nearest surface."""
        x, y, z = np.ascontiguousarray(points_camera.T)
        cell, inside = self._cells(x, y, z)
        nearest = buffer[cell]
        found = np.zeros(len(points_camera), np.bool_)
        found[inside] = np.isfinite(nearest) & (z[inside] < nearest * (1 - _TOLERANCE_FRACTION) - _TOLERANCE_M)
        return found

    def _cells(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[NDArray[np.intp], BoolArray]:
        """Return the coarse pixels (M,) of the points inside the image, and a mask (N,) of these points."""
        camera = self._camera
        front = z > _NEAREST_M
        shrink = 1 / np.where(front, z, 1)
        u, v = x * shrink, y * shrink
        u *= camera.fx
        u += camera.cx
        v *= camera.fy
        v += camera.cy
        inside = front & (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
        cell = np.rint(v[inside]).astype(np.intp)
        cell *= camera.width
        cell += np.rint(u[inside]).astype(np.intp)
        return cell, inside
