"""Matches as measurements of pixels and ranges, with their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.ray_ransac import front_rotations

_FARTHEST_SIGMA = 8.0  # a larger range error belongs to an outlier, whose rho must stay bounded
_NEAREST = 0.05  # lower bound of rho, relative to the measured range


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Matches with their noise; pixels are undistorted, in the image plane z = 1.

    Distortion is removed once and then only affects the noise: over the few pixels of an inlier's residual it is linear
    to 1e-3, and outliers need not be exact.
    """

    rays: FloatArray
    """(3, N) unit, scanner frame."""
    ranges: FloatArray
    """(N,) m."""
    range_information: FloatArray
    """(N,) 1/sigma_r^2, 1/m^2."""
    xy: FloatArray
    """(2, N) undistorted image coordinates, tangents; NaN outside the field of the lens."""
    information: FloatArray
    """(2, N) elements xx and yy of the inverse covariance of `xy`."""
    cross_information: FloatArray
    """(1, N) element xy of the inverse covariance."""
    least_rho: FloatArray
    """(N,) lower bound of the adjusted range, m."""
    most_rho: FloatArray
    """(N,) upper bound of the adjusted range, m."""
    correlated: bool
    """False if `cross_information` is zero throughout, as it is without distortion."""
    fronts: FloatArray | None = None
    """(N, 3, 3) rotations that turn the observed ray of each match to the Z axis, from camera axes; None: the image
    plane is that of the camera. A wide camera has no image plane, and `xy` are tangents around the observed rays."""

    @staticmethod
    def of(matches: Matches, camera: CameraModel, *, sigma_px: float, sigma_range_m: float) -> Measurements:
        """Return the measurements of matches; the weight of a match multiplies its information.

        A line end known only across the line has the information of a point-to-line distance, which is of rank 1.
        """
        xy, D, fronts = _undistorted(matches.uv, camera)
        by_weight = matches.weights / sigma_px**2
        diagonal = (D * D).sum(axis=0)
        cross = (D[:, 0] * D[:, 1]).sum(axis=0, keepdims=True)
        if matches.across.any():
            u, v = matches.directions.T
            normal = -v * D[0] + u * D[1]  # (2, N) d (distance across the line) / d xy
            diagonal = np.where(matches.across, normal * normal, diagonal)
            cross = np.where(matches.across, normal[:1] * normal[1:], cross)
        of_range = matches.weights * matches.range_weights
        reach = _FARTHEST_SIGMA * sigma_range_m / np.sqrt(of_range)
        return Measurements(
            np.ascontiguousarray(matches.rays.T),
            matches.ranges,
            of_range / sigma_range_m**2,
            xy,
            diagonal * by_weight,
            cross * by_weight,
            np.maximum(matches.ranges - reach, _NEAREST * matches.ranges),
            matches.ranges + reach,
            bool(cross.any()),
            fronts,
        )

    def with_noise(self, *, px_factor: float, range_factor: float) -> Measurements:
        """Return the same measurements with the standard deviations of pixels and ranges multiplied by factors."""
        reach = range_factor * (self.most_rho - self.ranges)
        return replace(
            self,
            range_information=self.range_information / range_factor**2,
            information=self.information / px_factor**2,
            cross_information=self.cross_information / px_factor**2,
            least_rho=np.maximum(self.ranges - reach, _NEAREST * self.ranges),
            most_rho=self.ranges + reach,
        )

    def __len__(self) -> int:
        return len(self.ranges)

    def subset(self, keep: BoolArray | IntArray) -> Measurements:
        """Return the measurements of a mask (N,) or of indices."""
        return Measurements(
            self.rays[:, keep],
            self.ranges[keep],
            self.range_information[keep],
            self.xy[:, keep],
            self.information[:, keep],
            self.cross_information[:, keep],
            self.least_rho[keep],
            self.most_rho[keep],
            self.correlated,
            None if self.fronts is None else self.fronts[keep],
        )


def _undistorted(uv: FloatArray, camera: CameraModel) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return the tangents (2, N) of pixels (N, 2), their derivatives D (2, 2, N) = d uv / d xy, and `fronts`.

    D is 0 outside the field of the lens.
    """
    fronts: FloatArray | None = None
    pinhole = camera.as_pinhole
    if pinhole is not None and not pinhole.distortion:
        focal = np.array([[pinhole.fx], [pinhole.fy]])
        D = np.zeros((2, 2, len(uv)))
        D[0, 0], D[1, 1] = pinhole.fx, pinhole.fy
        return (uv.T - [[pinhole.cx], [pinhole.cy]]) / focal, D, None
    rays_camera = camera.unproject(uv)
    if pinhole is not None:
        ideal = rays_camera / rays_camera[:, 2:]
        _, d_uv = camera.project_with_jacobian(ideal)
    else:
        fronts = front_rotations(rays_camera)
        _, d_uv = camera.project_with_jacobian(rays_camera)
        d_uv = d_uv @ fronts.swapaxes(1, 2)
        ideal = np.where(np.isfinite(rays_camera).all(axis=1, keepdims=True), [0.0, 0.0, 1.0], np.nan)
        fronts = np.where(np.isfinite(fronts), fronts, np.eye(3))
    D = np.asarray(d_uv[..., :2].transpose(1, 2, 0))
    D = np.where(np.isfinite(D).all(axis=(0, 1)), D, 0.0)
    return np.ascontiguousarray(ideal[:, :2].T), D, fronts
