"""The laser's depth at the pixels of a photograph."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, cube_faces
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges, scan_mesh
from ladarreg_core.surface.visibility.occluding_surface import occluding_surface
from ladarreg_core.surface.visibility.rasterise import covering_pinhole, rasterise_depth
from ladarreg_core.surface.visibility.visible_points import LARGEST_WHOLE_SCAN, places_in_picture

_MAX_PIXELS = 16_000_000  # of a band that is rasterised at once
_ROWS_AT_ONCE = 256
_RAYS_AT_ONCE = 400_000
_SAME_SURFACE = 0.02  # relative change of the depth within one pixel; beyond it, nothing is interpolated
_FINER = 1.5  # pixels of the ideal picture per pixel of a distorted one
_TOLERANCE_SIGMAS = 4.0
_FACES_AT_ONCE = 1_000_000


def depth_map(
    scan: Scan,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    *,
    only_seen: bool = False,
    report: Callable[[], None] = lambda: None,
) -> NDArray[np.float32]:
    """Return the depth of the scan's surface at every pixel centre of a photograph.

    The surface is the scan's mesh, without triangles across depth edges; nothing is filled in.

    Args:
        scan: the scan.
        camera: the camera.
        camera_from_scanner: its pose.
        only_seen: leave out what the photograph cannot show: the backs of surfaces, what is behind them, and what is
            behind the half cell by which the near side of a depth edge extends beyond its outermost points.
        report: called for every part; may raise `Cancelled`.

    Returns:
        (height, width) float32, m: z in the camera's axes for a pinhole, the distance from its centre for a fisheye or
        equirectangular camera; NaN where the scan has no surface.
    """
    pinhole = camera.as_pinhole
    if pinhole is not None and not any(pinhole.distortion):
        return _of_ideal(scan, pinhole, camera_from_scanner, only_seen, report)
    if pinhole is not None:
        ideal = covering_pinhole(pinhole, scale=_FINER)
        return _looked_up(
            pinhole, _InverseDepth(_of_ideal(scan, ideal, camera_from_scanner, only_seen, report)), ideal, report
        )
    result = np.full((camera.height, camera.width), np.nan, np.float32)
    for face in cube_faces(camera, scale=_FINER):
        turned = Rigid(face.face_from_camera, np.zeros(3)) @ camera_from_scanner
        inverse = _InverseDepth(_of_ideal(scan, face.camera, turned, only_seen, report))
        for rows, rays in _rays(camera, report):
            of_face = rays @ face.face_from_camera.T.astype(np.float32)
            here = face.holds(of_face)
            at = face.camera.project(of_face)
            depth = inverse.depth_at(at, here)
            along = np.linalg.norm(of_face, axis=-1) / np.where(here, of_face[..., 2], np.float32(1))
            result[rows][here] = (depth * along)[here]
    return result


def _meshes(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> Iterator[tuple[FloatArray, IntArray]]:
    """Yield the scan's mesh, of a large scan in parts: vertices (N, 3) in the camera's axes, and faces."""
    for part in _parts(scan, camera, camera_from_scanner):
        mesh = scan_mesh(part)
        yield camera_from_scanner @ mesh.vertices.astype(np.float64), mesh.faces


def _parts(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> Iterator[Scan]:
    """Yield the scan, of a large one the parts that a camera may see; their meshes meet."""
    if scan.ranges.size <= LARGEST_WHOLE_SCAN:
        yield scan
        return
    for rows, columns in places_in_picture(scan, camera, camera_from_scanner):
        parts = zip((rows, columns), scan.shape, strict=True)
        beyond = [slice(part.start, min(part.stop + 1, size)) for part, size in parts]
        try:
            yield scan.window(beyond[0], beyond[1])
        except ShapeError:  # without returns
            continue


def _of_ideal(
    scan: Scan, camera: Camera, camera_from_scanner: Rigid, only_seen: bool, report: Callable[[], None]
) -> NDArray[np.float32]:
    """Return z (h, w), NaN without a surface, of a pinhole without distortion; large pictures in bands."""
    shape = (camera.height, camera.width)
    depth = np.full(shape, np.inf, np.float32)
    nearest = np.full(shape, np.inf, np.float32) if only_seen else None
    noise_m = 0.0
    for part in _parts(scan, camera, camera_from_scanner):
        mesh = scan_mesh(part)
        points = camera_from_scanner @ mesh.vertices.astype(np.float64)
        if nearest is None:
            _draw(points, mesh.faces, camera, depth, report)
            continue
        _draw(points, mesh.faces[_face_the_camera(points, mesh.faces)], camera, depth, report)
        vertices, faces = occluding_surface(part)
        _draw(camera_from_scanner @ vertices.astype(np.float64), faces, camera, nearest, report)
        noise_m = max(noise_m, grid_edges(part).noise_m)
    if nearest is not None:
        margin = np.float32(_TOLERANCE_SIGMAS * noise_m)
        for first in range(0, camera.height, _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            hidden = depth[rows] > nearest[rows] * np.float32(1 + _SAME_SURFACE) + margin
            depth[rows][hidden] = np.inf
    depth[np.isinf(depth)] = np.nan
    return depth


def _draw(
    points: FloatArray, faces: IntArray, camera: Camera, depth: NDArray[np.float32], report: Callable[[], None]
) -> None:
    """Draw triangles into a depth buffer, (h, w) with infinity where there is nothing, by bands."""
    rows = max(1, _MAX_PIXELS // camera.width)
    v = camera.project(points)[:, 1] if camera.height > rows else None
    for first in range(0, camera.height, rows):
        report()
        band = slice(first, min(first + rows, camera.height))
        part = Camera(camera.width, band.stop - first, camera.fx, camera.fy, camera.cx, camera.cy - first)
        chosen = faces if v is None else faces[_touches(v[faces], first, band.stop)]
        np.minimum(depth[band], rasterise_depth(points, chosen, part), out=depth[band])


def _face_the_camera(points: FloatArray, faces: IntArray) -> BoolArray:
    """Return which triangles (F, 3) of points in the camera's axes show it their front: the side of the scanner."""
    result = np.empty(len(faces), np.bool_)
    for first in range(0, len(faces), _FACES_AT_ONCE):
        a, b, c = (points[faces[first : first + _FACES_AT_ONCE, k]] for k in range(3))
        result[first : first + _FACES_AT_ONCE] = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    return result


def _touches(v: FloatArray, first: int, last: int) -> BoolArray:
    """Return which triangles, given the rows of their corners (F, 3), reach into a band; NaN: behind the camera."""
    with np.errstate(invalid="ignore"):
        return np.asarray(~((v.max(axis=1) < first - 1) | (v.min(axis=1) > last + 1)))


class _InverseDepth:
    """1 / z in an ideal picture, (h, w), which is linear on planes.

    Args:
        depth: (h, w) z; NaN without a surface.
    """

    def __init__(self, depth: NDArray[np.float32]) -> None:
        self._inverse: NDArray[np.float32] = np.nan_to_num(np.float32(1) / depth, nan=0.0)
        square = np.ones((2, 2), np.uint8)
        # Of the four pixels around each position.
        self._farthest: NDArray[np.float32] = np.asarray(cv2.erode(self._inverse, square, anchor=(0, 0)), np.float32)
        self._closest: NDArray[np.float32] = np.asarray(cv2.dilate(self._inverse, square, anchor=(0, 0)), np.float32)

    def depth_at(self, at: FloatArray, wanted: BoolArray) -> NDArray[np.float32]:
        """Return z at positions (H, W, 2): bilinear on a surface, that of the nearest pixel at depth edges.

        Beside pixels without a surface there is none either.
        """
        height, width = self._inverse.shape
        inside = wanted & np.isfinite(at).all(axis=-1)
        u = np.clip(np.where(inside, at[..., 0], -10), -10, width + 10).astype(np.float32)
        v = np.clip(np.where(inside, at[..., 1], -10), -10, height + 10).astype(np.float32)
        extremes: tuple[FloatArray, FloatArray] = (self._farthest, self._closest)
        farthest, closest = (_values(picture, np.floor(u), np.floor(v), cv2.INTER_NEAREST) for picture in extremes)
        smooth, nearest = (_values(self._inverse, u, v, how) for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.where(closest - farthest <= _SAME_SURFACE * closest, smooth, nearest)
            return np.asarray(np.where(farthest > 0, np.float32(1) / found, np.float32(np.nan)), dtype=np.float32)


def _values(picture: FloatArray, u: FloatArray, v: FloatArray, how: int) -> NDArray[np.float32]:
    return np.asarray(cv2.remap(picture, u, v, how, borderMode=cv2.BORDER_CONSTANT), dtype=np.float32)


def _looked_up(
    camera: Camera, inverse: _InverseDepth, ideal: Camera, report: Callable[[], None]
) -> NDArray[np.float32]:
    result = np.empty((camera.height, camera.width), np.float32)
    for rows, rays in _rays(camera, report):
        result[rows] = inverse.depth_at(ideal.project(rays), np.ones(rays.shape[:2], np.bool_))
    return result


def _rays(camera: CameraModel, report: Callable[[], None]) -> Iterator[tuple[slice, FloatArray]]:
    """Yield rows of a picture with the rays (h, w, 3) of their pixels."""
    at_once = max(1, _RAYS_AT_ONCE // camera.width)
    for first in range(0, camera.height, at_once):
        report()
        rows = slice(first, min(first + at_once, camera.height))
        uv = np.stack(np.meshgrid(np.arange(camera.width), np.arange(rows.start, rows.stop)), axis=-1)
        yield rows, camera.unproject(uv).astype(np.float32)
