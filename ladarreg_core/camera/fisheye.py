"""The fisheye camera: the distance from the principal point is a polynomial of the angle from the optical axis.

Source: Kannala and Brandt, A generic camera model and calibration method (PAMI 2006), in the form of OpenCV's `fisheye`
module; that module divides by z, and thereby mirrors what lies beyond 90 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera.focal import FocalCamera
from ladarreg_core.foundations.arrays import FloatArray

_NEWTON_STEPS = 20
_TABLE = 4000


@dataclass(frozen=True, repr=False)
class FisheyeCamera(FocalCamera):
    """Fisheye intrinsics with 0 or 4 terms k1 to k4; the interface is that of `CameraModel`.

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    """

    model: ClassVar[str] = "fisheye"
    _term_counts: ClassVar[tuple[int, ...]] = (0, 4)

    @property
    def largest_angle_rad(self) -> float:
        """The largest angle from the optical axis that the polynomial maps to one pixel only; pi if it never folds."""
        return self._table[0]

    @property
    def as_pinhole(self) -> None:
        """None: no plane holds its image."""

    def depth_of(self, points_camera: FloatArray) -> FloatArray:
        """Return the distance (...) of points (..., 3) from the camera's center, m."""
        x, y, z = np.moveaxis(points_camera, -1, 0)
        return np.asarray(np.sqrt(np.square(x) + np.square(y) + np.square(z)))

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Project points (..., 3), camera frame, m; float32 stays float32.

        Returns:
            uv (..., 2), pixels; NaN for points at the camera's centre, and beyond the angle at which the polynomial
            folds back. Points beside and behind the camera are projected like all others.
        """
        p = np.asarray(points_camera)
        if p.dtype.kind != "f":
            p = p.astype(np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            radius = np.hypot(x, y)
            scale = self._polynomial(self._angle(radius, z)) / radius
            scale = np.where((radius == 0) & (z > 0), 0, scale).astype(p.dtype)
            uv = [x * scale * p.dtype.type(self.fx) + p.dtype.type(self.cx),
                  y * scale * p.dtype.type(self.fy) + p.dtype.type(self.cy)]  # fmt: skip
        return np.stack(uv, axis=-1)

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return uv (..., 2) as `project`, and its derivative by the point (..., 2, 3), px/m."""
        p = np.asarray(points_camera, dtype=np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            radius = np.hypot(x, y)
            angle = self._angle(radius, z)
            on_axis = (radius == 0) & (z > 0)
            slope = self._polynomial_slope(angle)
            square = radius * radius + z * z
            across = np.where(on_axis, 1 / z, self._polynomial(angle) / radius)
            along = np.where(on_axis, 1 / z, slope * z / square)
            mx, my = (np.where(on_axis, 0.0, each / radius) for each in (x, y))
            d_uv = np.empty((*x.shape, 2, 3))
            d_uv[..., 0, 0] = along * mx * mx + across * my * my
            d_uv[..., 1, 1] = along * my * my + across * mx * mx
            d_uv[..., 0, 1] = d_uv[..., 1, 0] = (along - across) * mx * my
            d_uv[..., 0, 2] = -slope * radius / square * mx
            d_uv[..., 1, 2] = -slope * radius / square * my
        d_uv[..., 0, :] *= self.fx
        d_uv[..., 1, :] *= self.fy
        return self.project(p), d_uv

    def unproject(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of pixels (..., 2); NaN outside the image circle that the polynomial fills."""
        p = np.asarray(uv, dtype=np.float64)
        x, y = (p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy
        mapped = np.hypot(x, y)
        angle = self._inverse(mapped)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(mapped > 0, np.sin(angle) / mapped, 0.0)
        return np.stack([x * scale, y * scale, np.cos(angle)], axis=-1)

    @property
    def _terms(self) -> tuple[float, ...]:
        return self.distortion or (0.0,) * 4

    @cached_property
    def _table(self) -> tuple[float, FloatArray, FloatArray]:
        """The largest angle before the polynomial folds back, and angles up to it with what they are mapped to."""
        angle = np.linspace(0, np.pi, _TABLE)
        falling = np.flatnonzero(~(self._polynomial_slope(angle) > 0))
        largest = float(angle[max(falling[0] - 1, 1)]) if len(falling) else np.pi
        angle = np.linspace(0, largest, _TABLE)
        return largest, angle, self._polynomial(angle)

    def _angle(self, radius: FloatArray, z: FloatArray) -> FloatArray:
        """Return the angle from the axis; NaN at the camera's centre, straight behind it, and beyond the fold."""
        angle = np.arctan2(radius, z)
        return np.where((angle <= self._table[0]) & ((radius > 0) | (z > 0)), angle, np.nan).astype(angle.dtype)

    def _polynomial(self, angle: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = (angle.dtype.type(k) for k in self._terms)
        s = angle * angle
        return np.asarray(angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))))

    def _polynomial_slope(self, angle: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self._terms
        s = angle * angle
        return np.asarray(1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4))))

    def _inverse(self, mapped: FloatArray) -> FloatArray:
        """Invert the polynomial by Newton's method from a table."""
        _, angles, values = self._table
        angle = np.where(mapped <= values[-1], np.interp(mapped, values, angles), np.nan)
        for _ in range(_NEWTON_STEPS):
            with np.errstate(invalid="ignore"):
                step = (self._polynomial(angle) - mapped) / self._polynomial_slope(angle)
            angle = angle - step
            if not (np.abs(step) >= 1e-14).any():
                break
        return np.asarray(angle)
