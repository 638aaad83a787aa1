"""Rasterises triangles into the image of an ideal camera, with a z-buffer."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray, IntArray

_NEAR_M = 0.01
_WIDEST_HALF_ANGLE_RAD = np.deg2rad(75)
_MAX_PIXELS = 24_000_000
_BORDER_SAMPLES = 64


def rasterise_depth(points_camera: FloatArray, faces: IntArray, camera: Camera) -> NDArray[np.float32]:
    """Return the depth of the nearest triangle at each pixel centre.

    Args:
        points_camera: (N, 3) finite vertices, camera frame, m.
        faces: (F, 3) int32.
        camera: the camera; its distortion is not applied.

    Returns:
        depth (H, W) float32, z in m, infinite without a triangle. Triangles are clipped 1 cm in front of the camera.
    """
    return _rasterise(points_camera, faces, None, camera)[0]


def rasterise_values(
    points_camera: FloatArray, faces: IntArray, values: FloatArray, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Interpolate values of the vertices over the nearest triangle at each pixel centre, linearly in space.

    Args:
        points_camera: (N, 3) finite vertices, camera frame, m.
        faces: (F, 3) int32.
        values: (N, 3) within 0 to 1.
        camera: the camera; its distortion is not applied.

    Returns:
        depth (H, W) as `rasterise_depth`, and values (H, W, 3) float32, 0 without a triangle.
    """
    depth, drawn = _rasterise(points_camera, faces, values, camera)
    assert drawn is not None
    return depth, drawn


def covering_pinhole(camera: Camera, *, scale: float = 1.0) -> Camera:
    """Return an ideal camera of `scale` times the focal length that covers the image of a distorted one.

    Directions over 75 degrees off the axis are left out, since a plane image of them grows without bound; resolution is
    reduced if the image would have more than 24 million pixels.
    """
    if not camera.distortion:
        return camera.scaled(scale)
    u = np.linspace(-0.5, camera.width - 0.5, _BORDER_SAMPLES)
    v = np.linspace(-0.5, camera.height - 0.5, _BORDER_SAMPLES)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)
    ideal = rays[np.isfinite(rays).all(axis=-1)]
    limit = float(np.tan(_WIDEST_HALF_ANGLE_RAD))
    xy = np.clip(ideal[:, :2] / ideal[:, 2:], -limit, limit) if len(ideal) else np.zeros((1, 2))
    low, high = xy.min(axis=0), xy.max(axis=0)
    fx, fy = camera.fx * scale, camera.fy * scale
    width, height = (high - low) * (fx, fy) + 4
    shrink = min(1.0, float(np.sqrt(_MAX_PIXELS / (width * height))))
    fx, fy = fx * shrink, fy * shrink
    return replace(
        camera.without_distortion(),
        width=int(np.ceil((high[0] - low[0]) * fx)) + 4,
        height=int(np.ceil((high[1] - low[1]) * fy)) + 4,
        fx=fx,
        fy=fy,
        cx=1.5 - low[0] * fx,
        cy=1.5 - low[1] * fy,
    )


def _rasterise(
    points_camera: FloatArray, faces: IntArray, values: FloatArray | None, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    width, height = camera.size
    points = np.ascontiguousarray(points_camera, dtype=np.float32)
    colors = None if values is None else np.ascontiguousarray(values, dtype=np.float32)
    drawn = None if colors is None else np.zeros((height, width, 3), dtype=np.float32)
    if len(points) and points[:, 2].min() < _NEAR_M:
        points, faces, colors = _clipped(points, np.asarray(faces), colors)
    if not len(faces):
        return np.full((height, width), np.inf, dtype=np.float32), drawn
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    farthest, nearest = float(points[:, 2].max()), float(points[:, 2].min())
    far = farthest * 1.01 + 1.0
    depth = np.full((height, width), far, dtype=np.float32)
    # OpenCV expects a vertical field of view and a centred principal point. Shearing the vertices moves the principal
    # point and scaling them turns fy into fx, so no padding is needed. Its pixel centres are at +.5, and its camera
    # looks along -z with y up.
    shaped = np.array(
        [
            [camera.fx / camera.fy, 0.0, (camera.cx + 0.5 - width / 2) / camera.fy, 0.0],
            [0.0, 1.0, (camera.cy + 0.5 - height / 2) / camera.fy, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    from_camera = np.diag([1.0, -1.0, -1.0, 1.0]) @ shaped
    field_of_view = 2 * float(np.arctan(height / 2 / camera.fy))
    settings = cv2.TriangleRasterizeSettings()
    settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    lens = (from_camera, field_of_view, nearest / 2, far, settings)  # the z-buffer is finest near the near plane
    if colors is None or drawn is None:
        cv2.triangleRasterizeDepth(points, faces, depth, *lens)
    else:
        cv2.triangleRasterize(points, faces, colors, drawn, depth, *lens)
    depth[depth > farthest * 1.005 + 0.5] = np.inf
    return depth, drawn


def _clipped(
    points: NDArray[np.float32], faces: IntArray, values: NDArray[np.float32] | None
) -> tuple[NDArray[np.float32], IntArray, NDArray[np.float32] | None]:
    """Clip triangles at the near plane: those behind are removed, those across it become one or two triangles."""
    in_front = points[:, 2] >= _NEAR_M
    count = in_front[faces].sum(axis=1)
    kept = [faces[count == 3]]
    all_points, all_values = [points], [values] if values is not None else []
    start = len(points)
    for corners_in_front in (1, 2):
        crossing = faces[count == corners_in_front]
        if not len(crossing):
            continue
        # Rotate the corners so that the odd one, alone on its side, comes first.
        odd = np.argmax(in_front[crossing] == (corners_in_front == 1), axis=1)
        a, b, c = (np.take_along_axis(crossing, ((odd + k) % 3)[:, None], axis=1)[:, 0] for k in range(3))
        n = len(crossing)
        for other in (b, c):
            t = ((_NEAR_M - points[a, 2]) / (points[other, 2] - points[a, 2]))[:, None].astype(np.float32)
            cut = points[a] + t * (points[other] - points[a])
            cut[:, 2] = _NEAR_M
            all_points.append(cut)
            if values is not None:
                all_values.append(values[a] + t * (values[other] - values[a]))
        ab, ac = start + np.arange(n), start + n + np.arange(n)
        start += 2 * n
        if corners_in_front == 1:
            kept.append(np.stack([a, ab, ac], axis=-1))
        else:
            kept += [np.stack([ab, b, c], axis=-1), np.stack([ab, c, ac], axis=-1)]
    faces = np.concatenate(kept)
    points = np.concatenate(all_points)
    used = np.zeros(len(points), np.bool_)
    used[faces] = True  # points behind must not enter the projection
    number = np.cumsum(used) - 1
    return points[used], number[faces], np.concatenate(all_values)[used] if values is not None else None
