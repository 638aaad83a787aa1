"""Intrinsics of a camera as unknowns: their names, their values, derivatives, and the camera after a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError
from ladarreg_core.foundations.arrays import FloatArray

Intrinsics = Literal["fixed", "focal", "focal_k1", "focal_k1_centre"]
"""Intrinsics estimated with the pose: none; a common scale of fx and fy; also k1; also the principal point."""

PARAMETERS: Mapping[Intrinsics, tuple[str, ...]] = {
    "fixed": (),
    "focal": ("focal_px",),
    "focal_k1": ("focal_px", "k1"),
    "focal_k1_centre": ("focal_px", "k1", "cx", "cy"),
}
"""Names of the estimated intrinsics, in the order of the covariance."""
_MAX_FOCAL_FACTOR = 10.0


def values_of(camera: Camera) -> FloatArray:
    """Return (log f, k1, cx, cy)."""
    return np.array([np.log(camera.focal_px), intrinsic(camera, "k1"), camera.cx, camera.cy])


def intrinsic_columns(camera: Camera, xy: FloatArray, count: int) -> FloatArray:
    """Return d xy / d (log f, k1, cx, cy), the first `count` of them, as derivatives of the predicted tangents.

    Args:
        camera: intrinsics.
        xy: (2, N) predicted tangents.
        count: K.

    Returns:
        (K, 2, N); 0 outside the field of the lens.
    """
    if not count:
        return np.zeros((0, *xy.shape))
    if not camera.distortion:
        by_k1 = xy * (xy * xy).sum(axis=0)
        fx, fy = np.zeros((2, *xy.shape))
        fx[0], fy[1] = 1 / camera.fx, 1 / camera.fy
        return np.stack([xy, by_k1, fx, fy][:count])
    ideal = np.column_stack([*xy, np.ones(xy.shape[1])])
    _, d_uv = camera.project_with_jacobian(ideal)
    by_theta = camera.intrinsics_jacobian(xy.T)[..., :count]
    (a, b), (c, d) = np.moveaxis(d_uv[..., :2], 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = a * d - b * c
        u, v = by_theta[:, 0].T, by_theta[:, 1].T  # (K, N)
        columns = np.stack([d * u - b * v, a * v - c * u], axis=1) / determinant
    return np.where(np.isfinite(columns), columns, 0.0)


def intrinsic(camera: Camera, name: str) -> float:
    """Return an intrinsic of a camera by its name in `PARAMETERS`."""
    if name == "k1":
        return camera.distortion[0] if camera.distortion else 0.0
    return float(getattr(camera, name))


def updated(camera: Camera, step: FloatArray) -> Camera | None:
    """Return the camera after a step (K,) of (log f, k1, cx, cy); None if that is invalid."""
    if not len(step):
        return camera
    log_f, k1, cx, cy = map(float, np.pad(step, (0, 4 - len(step))))
    factor = float(np.exp(log_f))
    first, *others = camera.distortion or (0.0,) * 4
    try:
        return replace(
            camera,
            fx=camera.fx * factor,
            fy=camera.fy * factor,
            cx=camera.cx + cx,
            cy=camera.cy + cy,
            distortion=(first + k1, *others),
        )
    except CameraError:
        return None


def is_plausible(camera: Camera, first: Camera) -> bool:
    """Return whether a camera is plausible: bounded change, and no folding inside the image that the first lacked."""
    if not 1 / _MAX_FOCAL_FACTOR <= camera.focal_px / first.focal_px <= _MAX_FOCAL_FACTOR:
        return False
    if not camera.contains([camera.cx, camera.cy]) and first.contains([first.cx, first.cy]):
        return False
    if camera.distortion == first.distortion and not camera.distortion:
        return True
    w, h = camera.width - 1.0, camera.height - 1.0
    border = np.array([[u, v] for u in (0.0, w / 2, w) for v in (0.0, h / 2, h)])
    lost = np.isnan(camera.unproject(border)).any(axis=1)
    return not lost.any() or not (lost & ~np.isnan(first.unproject(border)).any(axis=1)).any()
