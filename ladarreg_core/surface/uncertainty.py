"""Uncertainty of the registered image at every cell of a scan, propagated from the pose's covariance.

With R_true = exp([w]x) R and C_true = C + c a point X of the camera frame moves by w x X - R c. At z = 1 that is linear
in (w, R c), with rows of x, y and 1/z alone, so that the pixel's covariance is a sum over six directions:

    J S J^T = sum_k (J l_k) (J l_k)^T,    S = L L^T
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, require_camera
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.validation import require_choice, require_number
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.remap import look_up

Measure = Literal["longer_axis", "total"]
"""`longer_axis`: root of the larger eigenvalue of the pixel's covariance; `total`: root of its trace."""

_CHUNK = 8192  # points; the planes of a chunk fit the processor's cache
_NET_NODES, _NET_MARGIN = 161, 0.4
_MAX_ROUNDING_PX = 1e-3
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
_MAX_SIGMA_RANGE_M = 1e6
_MIN_COSINE = 0.02


def picture_sigma(
    scan: Scan,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    covariance: FloatArray | CameraUncertainty,
    *,
    sigma_range_m: float = 0.0,
    measure: Measure = "longer_axis",
) -> NDArray[np.float32]:
    """Return the standard deviation of the photo pixel of each cell of a scan.

    Cells that are hidden or out of the frame have one, too, for the pixel that they project to.

    Args:
        scan: the scan.
        camera: intrinsics, with or without distortion.
        camera_from_scanner: the pose.
        covariance: (6, 6) of (w, c) as `PoseResult.covariance`, rad and m, or of pose and camera together.
        sigma_range_m: noise of a cell's own range, m; 0: the uncertainty of the pose alone.
        measure: `longer_axis`, the longer semi-axis of the one-sigma ellipse, at least 1 / sqrt 2 of `total`; or
            `total`, the root mean square length of the error.

    Returns:
        (H, W) float32, px; NaN without a return, behind the camera and beyond its lens.

    Raises:
        ShapeError: if the covariance is not (6, 6), finite, symmetric and positive.
        OptionError: if the range noise or the measure is invalid.
        CameraError: if `camera` is not a `Camera`.
    """
    joint = covariance if isinstance(covariance, CameraUncertainty) else None
    factor = covariance_factor(covariance)
    require_number(sigma_range_m, "sigma_range_m", least=0, most=_MAX_SIGMA_RANGE_M, unit="metres")
    require_choice(measure, get_args(Measure), "the measure")
    require_camera(camera, "the camera")
    points = scan.points.reshape(-1, 3)
    result = np.empty(len(points), dtype=np.float32)
    dtype = _precision_for(factor, camera, float(sigma_range_m))
    R, t = camera_from_scanner.rotation.astype(dtype), camera_from_scanner.translation.astype(dtype)[:, None]
    factor = _in_camera_axes(factor, camera_from_scanner.rotation).astype(dtype)
    lens = _Lens.of(camera, len(points))
    for first in range(0, len(points), _CHUNK):
        part = slice(first, first + _CHUNK)
        turned = R @ points[part].astype(dtype).T
        along = None
        if sigma_range_m:
            along = turned * (dtype(sigma_range_m) / scan.ranges.reshape(-1)[part].astype(dtype))
        result[part] = _sigma(turned + t, camera, factor, measure, lens=lens, along=along, joint=joint)
    return result.reshape(scan.shape)


def pixel_sigma(
    points_camera: FloatArray, camera: CameraModel, rotation: FloatArray, covariance: FloatArray | CameraUncertainty
) -> FloatArray:
    """Return the uncertainty of projected points due to the pose: the longer semi-axis of the one-sigma ellipse.

    Args:
        points_camera: (..., 3), m.
        camera: intrinsics.
        rotation: (3, 3) of `camera_from_scanner`.
        covariance: (6, 6) of (w, c), or of pose and camera together.

    Returns:
        sigma_px (...,), float32 for float32 points if precise enough; NaN behind the camera and beyond its lens.

    Raises:
        ShapeError: if the covariance is not (6, 6), finite, symmetric and positive.
    """
    points = np.asarray(points_camera)
    joint = covariance if isinstance(covariance, CameraUncertainty) else None
    factor = covariance_factor(covariance)
    dtype = np.float64 if points.dtype != np.float32 else _precision_for(factor, camera, 0.0)
    factor = _in_camera_axes(factor, rotation).astype(dtype)
    flat = points.reshape(-1, 3)
    result = np.empty(len(flat), dtype=dtype)
    lens = _Lens.of(camera, len(flat))
    for first in range(0, len(flat), _CHUNK):
        part = slice(first, first + _CHUNK)
        p = np.ascontiguousarray(flat[part].T, dtype=dtype)
        result[part] = _sigma(p, camera, factor, "longer_axis", lens=lens, joint=joint)
    return result.reshape(points.shape[:-1])


class SurfaceErrors(NamedTuple):
    """What moves the points of a surface under N pixels of a photograph: derivatives by independent errors.

    The point X = C + s d, on a surface with the unit normal n, is off by

        dX = (I - d n^T / (n . d)) (c + s dd) + d (n . l) / (n . d) dr

    where c is the error of the camera's centre, dd that of the ray's direction d, from the camera's rotation, its
    uncertain intrinsics and the pixel itself, and dr the error of the range there along the laser's ray l.
    """

    by_pose: NDArray[np.float64] | None
    """(N, P, 3) m, by each of P independent errors of one sigma, of pose and intrinsics, which are the same for all
    points of a photograph; None: not known."""
    by_pixel: NDArray[np.float64]
    """(N, 2, 3) m per px."""
    by_range: NDArray[np.float64]
    """(N, 3) m per m."""


def surface_errors(
    camera: CameraModel,
    camera_from_scanner: Rigid,
    covariance: FloatArray | CameraUncertainty | None,
    *,
    points: FloatArray,
    normals: FloatArray,
    uv: FloatArray,
) -> SurfaceErrors:
    """Return how far points of a surface, under pixels of a photograph, move by the errors of all that they rest on.

    Args:
        camera: intrinsics.
        camera_from_scanner: the pose.
        covariance: as `PoseResult.joint_covariance`.
        points: (N, 3) the points under the pixels, scanner frame, m.
        normals: (N, 3) unit normals there; a surface seen at less than about a degree is taken as seen at that.
        uv: (N, 2) the pixels.
    """
    R, d_camera = camera_from_scanner.rotation, camera.unproject(uv)
    d = d_camera @ R
    depth = np.linalg.norm(points - camera_from_scanner.centre, axis=1)[:, None, None]
    cosine = away_from_zero((normals * d).sum(axis=1))[:, None, None]

    def on_surface(moved: FloatArray) -> NDArray[np.float64]:
        along = (moved * normals[:, None]).sum(axis=-1, keepdims=True) / cosine
        return np.asarray(moved - along * d[:, None])

    by_direction = _direction_by_pixel(camera, uv, d_camera) @ R  # (N, 2, 3), 1/px
    by_pose = None
    if covariance is not None:
        factor = covariance_factor(covariance)
        turned = np.cross(d_camera[:, None], factor[:3].T[None]) @ R  # d_camera x w, in the scanner's axes
        moved = factor[3:6].T[None] + depth * turned
        pinhole = camera.as_pinhole
        if isinstance(covariance, CameraUncertainty) and pinhole is not None:
            by_lens = covariance.jacobian(pinhole, d_camera[:, :2] / d_camera[:, 2:]) @ factor[6:]
            moved = moved - depth * np.einsum("nki,nkp->npi", by_direction, by_lens)
        by_pose = on_surface(moved)
    laser = points / np.linalg.norm(points, axis=1, keepdims=True)
    by_range = d * (normals * laser).sum(axis=1, keepdims=True) / cosine[:, 0]
    return SurfaceErrors(by_pose, on_surface(depth * by_direction), by_range)


def away_from_zero(cosine: FloatArray) -> NDArray[np.float64]:
    """Return cosines of at least `_MIN_COSINE`, either sign kept."""
    return np.where(np.abs(cosine) < _MIN_COSINE, np.where(cosine > 0, 1, -1) * _MIN_COSINE, cosine)


def _direction_by_pixel(camera: CameraModel, uv: FloatArray, d_camera: FloatArray) -> NDArray[np.float64]:
    """Return the derivative of the rays' directions by the pixel (N, 2, 3), camera axes, 1/px."""
    rows = []
    for step in np.eye(2) * 0.5:
        ahead, behind = camera.unproject(uv + step), camera.unproject(uv - step)
        one_side = np.where(np.isfinite(ahead), ahead - d_camera, d_camera - behind) * 2
        rows.append(np.where(np.isfinite(ahead - behind), ahead - behind, one_side))
    return np.stack(rows, axis=1)


def covariance_factor(covariance: FloatArray | CameraUncertainty) -> NDArray[np.float64]:
    """Return L (6, 6), or (6 + K, 6 + K) of pose and camera, with covariance = L L^T.

    Raises:
        ShapeError: if it is not (6, 6), finite, symmetric and positive (beyond rounding).
    """
    if isinstance(covariance, CameraUncertainty):
        S: FloatArray = covariance.covariance
    else:
        S = read_only(covariance, np.float64, (6, 6), "the pose covariance")
    if not np.isfinite(S).all():
        raise ShapeError("the pose covariance contains NaN or infinity; it needs 36 finite numbers, rad and m")
    scale = np.sqrt(np.maximum(np.diag(S), 0))
    unit = np.where(scale > 0, scale, 1.0)
    scaled = S / np.outer(unit, unit)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    symmetric = bool(np.abs(scaled - scaled.T).max() <= 1e-6)
    if not symmetric or (np.diag(S) < 0).any() or values[0] < -1e-6:
        fault = "symmetric" if not symmetric else "positive"
        raise ShapeError(f"the pose covariance is not {fault}; give the covariance of a pose estimate")
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0)))


def _precision_for(factor: FloatArray, camera: CameraModel, sigma_range_m: float) -> type[np.floating[Any]]:
    """Return the precision needed: for a poorly determined pose, pixels move by large amounts that nearly cancel."""
    largest = max(float(np.linalg.norm(factor)), sigma_range_m)
    return np.float32 if largest * camera.focal_px * _ROUNDING < _MAX_ROUNDING_PX else np.float64


def _in_camera_axes(factor: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the factor of (w, R c) and, if there are any, of the intrinsics."""
    return np.vstack([factor[:3], np.asarray(rotation, dtype=np.float64) @ factor[3:6], factor[6:]])


def _sigma(
    p: FloatArray,
    camera: CameraModel,
    factor: FloatArray,
    measure: Measure,
    *,
    lens: _Lens | None,
    along: FloatArray | None = None,
    joint: CameraUncertainty | None = None,
) -> FloatArray:
    """Return the standard deviation (N,) of the pixels of points (3, N) in the camera frame.

    Args:
        p: (3, N).
        camera: intrinsics.
        factor: (6, 6) of (w, R c), or (6 + K, 6 + K) with the intrinsics of `joint`.
        measure: length returned.
        lens: distortion of the camera; None: no distortion.
        along: (3, N) additional error of each point, one sigma, m.
        joint: the uncertain intrinsics, if there are any.
    """
    pinhole = camera.as_pinhole
    if pinhole is None:
        return _wide_sigma(p, camera, factor, measure, along)
    rows = np.empty((2, 6, p.shape[1]), dtype=p.dtype)
    with np.errstate(all="ignore"):
        inverse_z = 1 / np.where(p[2] > 0, p[2], p.dtype.type(np.nan))
        x, y = p[0] * inverse_z, p[1] * inverse_z
        xy = x * y
        rows[0, 0], rows[0, 1], rows[0, 2] = -xy, 1 + x * x, -y
        rows[1, 0], rows[1, 1], rows[1, 2] = -1 - y * y, xy, x
        rows[0, 3], rows[0, 4], rows[0, 5] = -inverse_z, 0, x * inverse_z
        rows[1, 3], rows[1, 4], rows[1, 5] = 0, -inverse_z, y * inverse_z
        if joint is not None:
            rows = np.concatenate([rows, _by_intrinsics(pinhole, joint, x, y, lens)], axis=1)
        dx, dy = factor.T @ rows[0], factor.T @ rows[1]
        xx, cross, yy = _dot(dx, dx), _dot(dx, dy), _dot(dy, dy)
        if along is not None:
            by_x, by_y = (along[0] - x * along[2]) * inverse_z, (along[1] - y * along[2]) * inverse_z
            xx, cross, yy = xx + by_x * by_x, cross + by_x * by_y, yy + by_y * by_y
        if lens is not None:
            a, b, c, d = lens.slopes(x, y)
            uu = a * a * xx + 2 * a * b * cross + b * b * yy
            vv = c * c * xx + 2 * c * d * cross + d * d * yy
            uv = a * c * xx + (a * d + b * c) * cross + b * d * yy
        else:
            fx, fy = p.dtype.type(pinhole.fx), p.dtype.type(pinhole.fy)
            uu, uv, vv = fx * fx * xx, fx * fy * cross, fy * fy * yy
        if measure == "total":
            return np.asarray(np.sqrt(uu + vv))
        half = (uu - vv) / 2
        return np.asarray(np.sqrt((uu + vv) / 2 + np.sqrt(half * half + uv * uv)))


def _wide_sigma(
    p: FloatArray, camera: CameraModel, factor: FloatArray, measure: Measure, along: FloatArray | None
) -> FloatArray:
    """Return the standard deviation (N,) of the pixels of points (3, N) in the frame of a wide camera."""
    with np.errstate(all="ignore"):
        _, d_uv = camera.project_with_jacobian(p.T)  # (N, 2, 3)
        by_rotation = np.cross(p.T[:, None], d_uv)  # d p = w x p
        rows = np.concatenate([by_rotation, -d_uv], axis=2) @ factor[:6].astype(np.float64)
        if along is not None:
            rows = np.concatenate([rows, d_uv @ along.T[..., None].astype(np.float64)], axis=2)
        uu, vv, uv = ((rows[:, i] * rows[:, j]).sum(axis=1) for i, j in ((0, 0), (1, 1), (0, 1)))
        if measure == "total":
            return np.asarray(np.sqrt(uu + vv))
        half = (uu - vv) / 2
        return np.asarray(np.sqrt((uu + vv) / 2 + np.sqrt(half * half + uv * uv)))


def _by_intrinsics(
    camera: Camera, joint: CameraUncertainty, x: FloatArray, y: FloatArray, lens: _Lens | None
) -> FloatArray:
    """Return the shift of the tangents (N,) that has the effect of each intrinsic on the pixel, (2, K, N)."""
    by_u, by_v = (
        part.T.astype(x.dtype) for part in np.moveaxis(joint.jacobian(camera, np.stack([x, y], axis=-1)), 1, 0)
    )
    if lens is None:
        return np.stack([by_u / x.dtype.type(camera.fx), by_v / x.dtype.type(camera.fy)])
    a, b, c, d = lens.slopes(x, y)
    return np.stack([d * by_u - b * by_v, a * by_v - c * by_u]) / (a * d - b * c)


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """The derivative of the pixel with respect to the tangents (x, y), interpolated from a net for most points."""

    camera: Camera
    net: FloatArray | None
    """(K, K, 4) float32."""
    low: FloatArray
    """(2,) tangents of the first node."""
    step: FloatArray
    """(2,) tangents between nodes."""

    @staticmethod
    def of(camera: CameraModel, count: int) -> _Lens | None:
        """Return the lens, with a net if `count` points justify it; None without distortion, and of a wide camera."""
        pinhole = camera.as_pinhole
        if pinhole is None or not pinhole.distortion:
            return None
        whole = _Lens(pinhole, None, np.zeros(2), np.ones(2))
        if count < 2 * _NET_NODES**2:
            return whole
        edge = np.linspace(0, 1, _NET_NODES)
        border = [np.column_stack([s, t]) for k in (0.0, 1.0) for s, t in ((edge, 0 * edge + k), (0 * edge + k, edge))]
        rays = camera.unproject(np.concatenate(border) * (camera.width - 1, camera.height - 1))
        tangents = rays[np.isfinite(rays).all(axis=1), :2] / rays[np.isfinite(rays).all(axis=1), 2:]
        if len(tangents) < 2 or not (np.ptp(tangents, axis=0) > 0).all():
            return whole
        # Scans are often wider than the photo, but beyond its lens there is nothing to interpolate.
        for margin in (_NET_MARGIN, 0.0):
            low = tangents.min(axis=0) - margin * np.ptp(tangents, axis=0)
            step = np.ptp(tangents, axis=0) * (1 + 2 * margin) / (_NET_NODES - 1)
            x, y = (low[k] + step[k] * np.arange(_NET_NODES) for k in range(2))
            net = np.stack(whole._exact(*np.meshgrid(x, y)), axis=-1).astype(np.float32)
            if np.isfinite(net).all():
                break
        return _Lens(pinhole, net, low, step)

    def slopes(self, x: FloatArray, y: FloatArray) -> list[FloatArray]:
        """Return du/dx, du/dy, dv/dx and dv/dy (N,) at tangents (N,); NaN for NaN and beyond the lens."""
        if self.net is None:
            return self._exact(x, y)
        low, step, last = self.low.astype(np.float32), self.step.astype(np.float32), np.float32(_NET_NODES - 1)
        u, v = (x.astype(np.float32) - low[0]) / step[0], (y.astype(np.float32) - low[1]) / step[1]
        inside = (u >= 0) & (u <= last) & (v >= 0) & (v <= last)
        place = [np.where(inside, a, np.float32(0))[None] for a in (u, v)]
        found = np.array(look_up(self.net, place[0], place[1])[0].T, dtype=x.dtype, order="C")
        known = ~np.isnan(x)
        found[:, ~known] = np.nan
        exact = np.flatnonzero(known & ~(inside & np.isfinite(found[0])))
        if len(exact):
            found[:, exact] = self._exact(x[exact], y[exact])
        return list(found)

    def _exact(self, x: FloatArray, y: FloatArray) -> list[FloatArray]:
        uv, d_uv = self.camera.project_with_jacobian(np.stack([x, y, np.ones_like(x)], axis=-1))
        d_uv[np.isnan(uv[..., 0])] = np.nan  # beyond the lens the polynomial still has a slope
        return [d_uv[..., i, j].astype(x.dtype) for i in (0, 1) for j in (0, 1)]


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("kn,kn->n", a, b))
