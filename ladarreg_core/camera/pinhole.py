"""The pinhole camera with OpenCV's radial, tangential and thin prism distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera.focal import FocalCamera
from ladarreg_core.foundations.arrays import FloatArray

_NEWTON_STEPS = 20


@dataclass(frozen=True, repr=False)
class Camera(FocalCamera):
    """Pinhole intrinsics with 0, 4, 5, 8 or 12 terms of OpenCV's: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]."""

    model: ClassVar[str] = "pinhole"
    _term_counts: ClassVar[tuple[int, ...]] = (0, 4, 5, 8, 12)

    @staticmethod
    def from_focal(width: int, height: int, focal_px: float) -> Camera:
        """Return a camera without distortion, of one focal length, its principal point in the middle of the image."""
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K, (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def as_pinhole(self) -> Camera:
        """The camera itself."""
        return self

    def depth_of(self, points_camera: FloatArray) -> FloatArray:
        """Return z (...) of points (..., 3), camera frame, m."""
        return points_camera[..., 2]

    def without_distortion(self) -> Camera:
        """Return the same camera without distortion."""
        return replace(self, distortion=())

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Project points into the image.

        Args:
            points_camera: (..., 3), camera frame, m; float32 stays float32.

        Returns:
            uv (..., 2), pixels; NaN for points at or behind the camera, and for points so far off the axis that the
            distortion polynomial folds back into the image.
        """
        p = np.asarray(points_camera)
        if p.dtype.kind != "f":
            p = p.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            z = np.where(p[..., 2] > 0, p[..., 2], np.nan).astype(p.dtype)
            x, y = p[..., 0] / z, p[..., 1] / z
            if self.distortion:
                x, y = self._distort(x, y)
        return np.stack([x * p.dtype.type(self.fx) + p.dtype.type(self.cx),
                         y * p.dtype.type(self.fy) + p.dtype.type(self.cy)], axis=-1)  # fmt: skip

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Project points, with the derivative of the pixel with respect to the point.

        Args:
            points_camera: (..., 3), camera frame, m.

        Returns:
            uv (..., 2) as `project`, and d uv / d point (..., 2, 3), px/m.
        """
        p = np.asarray(points_camera, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
            x, y = p[..., 0] / z, p[..., 1] / z
            xd, yd, jacobian = (
                (*self._distort(x, y), self._distortion_jacobian(x, y)) if self.distortion else (x, y, None)
            )
            uv = np.stack([xd * self.fx + self.cx, yd * self.fy + self.cy], axis=-1)
            d_ideal = np.zeros((*x.shape, 2, 3))
            d_ideal[..., 0, 0] = d_ideal[..., 1, 1] = 1 / z
            d_ideal[..., 0, 2] = -x / z
            d_ideal[..., 1, 2] = -y / z
            d_uv = d_ideal if jacobian is None else jacobian @ d_ideal
            d_uv[..., 0, :] *= self.fx
            d_uv[..., 1, :] *= self.fy
        return uv, d_uv

    def unproject(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the unit ray of each pixel.

        Args:
            uv: (..., 2), pixels.

        Returns:
            rays_camera (..., 3), unit; NaN for pixels that the distortion maps no ray to.
        """
        p = np.asarray(uv, dtype=np.float64)
        xd, yd = (p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy
        x, y = self._undistort(xd, yd) if self.distortion else (xd, yd)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def intrinsics_jacobian(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Return the derivative of pixels with respect to (log f, k1, cx, cy), where f scales fx and fy alike.

        Args:
            xy: (..., 2), undistorted image coordinates (tangents).

        Returns:
            d uv / d (log f, k1, cx, cy), (..., 2, 4), px; the first columns are NaN beyond the fold of the distortion.
        """
        x, y = np.moveaxis(np.asarray(xy, dtype=np.float64), -1, 0)
        _, _, _, _, _, k4, k5, k6 = self._coefficients
        s = x * x + y * y
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            xd, yd = self._distort(x, y) if self.distortion else (x, y)
            by_k1 = s / (1 + s * (k4 + s * (k5 + s * k6)))
        J = np.zeros((*x.shape, 2, 4))
        J[..., 0, 0], J[..., 1, 0] = self.fx * xd, self.fy * yd
        J[..., 0, 1], J[..., 1, 1] = self.fx * x * by_k1, self.fy * y * by_k1
        J[..., 0, 2] = J[..., 1, 3] = 1.0
        return J

    @property
    def _coefficients(self) -> tuple[float, ...]:
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))[:8]

    @property
    def _prism(self) -> tuple[float, ...]:
        return self.distortion[8:] or (0.0,) * 4

    @cached_property
    def _fold_radius_squared(self) -> float:
        """The squared radius (x^2 + y^2) beyond which the radial polynomial folds back; infinite if it never does."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        r = np.tan(np.linspace(0, np.deg2rad(89), 4000))
        s = r * r
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            mapped = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        falling = np.flatnonzero(~(np.diff(mapped) > 0))
        return float(s[falling[0]]) if len(falling) else np.inf

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        k1, k2, p1, p2, k3, k4, k5, k6 = (np.asarray(x).dtype.type(k) for k in self._coefficients)
        s = x * x + y * y
        s = np.where(s <= self._fold_radius_squared, s, np.nan).astype(np.asarray(x).dtype)
        radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        xy2 = 2 * x * y
        xd, yd = x * radial + p1 * xy2 + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + p2 * xy2
        if len(self.distortion) == 12:
            s1, s2, s3, s4 = (np.asarray(x).dtype.type(k) for k in self._prism)
            xd, yd = xd + s * (s1 + s * s2), yd + s * (s3 + s * s4)
        return xd, yd

    def _distortion_jacobian(self, x: FloatArray, y: FloatArray) -> FloatArray:
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients
        s = x * x + y * y
        top, bottom = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
        radial = top / bottom
        slope = ((k1 + s * (2 * k2 + s * 3 * k3)) - radial * (k4 + s * (2 * k5 + s * 3 * k6))) / bottom
        J: Any = np.empty((*np.shape(x), 2, 2))
        J[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        J[..., 0, 1] = J[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        J[..., 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        if len(self.distortion) == 12:
            s1, s2, s3, s4 = self._prism
            by_s = np.stack([s1 + 2 * s2 * s, s3 + 2 * s4 * s], axis=-1)
            J += by_s[..., None] * np.stack([2 * x, 2 * y], axis=-1)[..., None, :]
        return np.asarray(J)

    def _undistort(self, xd: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Invert `_distort` by Newton's method: OpenCV's default iteration is off by .4 px for strong distortion."""
        x, y = self._radial_start(xd, yd)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(_NEWTON_STEPS):
                fx, fy = self._distort(x, y)
                J = self._distortion_jacobian(x, y)
                ex, ey = xd - fx, yd - fy
                det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
                dx = (J[..., 1, 1] * ex - J[..., 0, 1] * ey) / det
                dy = (J[..., 0, 0] * ey - J[..., 1, 0] * ex) / det
                x, y = x + dx, y + dy
                step = np.hypot(dx, dy)
                if not (step >= 1e-14).any():  # NaN: beyond the fold, final
                    break
            fx, fy = self._distort(x, y)
            found = np.hypot(fx - xd, fy - yd) < 1e-9
        return np.where(found, x, np.nan), np.where(found, y, np.nan)

    def _radial_start(self, xd: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Invert the radial part by a table, so that Newton's method starts inside the domain of the distortion."""
        limit = np.sqrt(min(self._fold_radius_squared, np.tan(np.deg2rad(89)) ** 2)) * 0.999
        r = np.tan(np.linspace(0, np.arctan(limit), 2000))
        mapped = np.hypot(*self._distort(r, np.zeros_like(r)))
        radius = np.hypot(xd, yd)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(radius > 1e-12, np.interp(radius, mapped, r) / radius, 1.0)
        return xd * factor, yd * factor
