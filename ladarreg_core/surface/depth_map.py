"""The laser's depth at the pixels of a photograph."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.camera import Camera, CameraModel, cube_faces
from ladarreg_core.errors import ShapeError
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh import grid_edges, scan_mesh
from ladarreg_core.surface.rasterise import covering_pinhole, rasterise_depth
from ladarreg_core.surface.visibility import LARGEST_WHOLE_SCAN, occluding_surface, places_in_picture

_MOST_PIXELS = 16_000_000  # of a band that is rasterised at once
_ROWS_AT_ONCE = 256
_RAYS_AT_ONCE = 400_000
_SAME_SURFACE = 0.02  # relative change of the depth within one pixel; beyond it, nothing is interpolated
_FINER = 1.5  # pixels of the ideal picture per pixel of a distorted one
_SQUARE_PX = 8
_ROUNDING_PX = 0.01  # lens distortion bends the sides of triangles by less
_BESIDE = 1e-6
_TOLERANCE_SIGMAS = 4.0
_FACES_AT_ONCE = 1_000_000
_PAIRS_AT_ONCE = 4_000_000


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
    if isinstance(camera, Camera) and not any(camera.distortion):
        return _of_ideal(scan, camera, camera_from_scanner, only_seen, report)
    if isinstance(camera, Camera):
        ideal = covering_pinhole(camera, scale=_FINER)
        return _looked_up(
            camera, _InverseDepth(_of_ideal(scan, ideal, camera_from_scanner, only_seen, report)), ideal, report
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


def depth_at(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid, uv: FloatArray) -> NDArray[np.float64]:
    """Return the depth of the scan's surface at some positions in a photograph, as `depth_map` does for its pixels.

    Args:
        scan: the scan.
        camera: the camera.
        camera_from_scanner: its pose.
        uv: (N, 2) px; (0, 0) is the centre of the first pixel.

    Returns:
        (N,) float64, m; NaN where the scan has no surface.

    Raises:
        ShapeError: if `uv` is not (N, 2).
    """
    uv = np.asarray(uv, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise ShapeError(f"the positions have the shape {uv.shape}; it must be (N, 2)")
    rays = camera.unproject(uv)
    usable = np.isfinite(rays).all(axis=1) & camera.contains(uv)
    distance = np.full(len(uv), np.inf)
    wanted = _Wanted.of(camera, uv[usable])
    for points, faces in _meshes(scan, camera, camera_from_scanner):
        corners_uv = camera.project(points)[faces]
        with np.errstate(invalid="ignore"):
            low, high = corners_uv.min(axis=1) - _ROUNDING_PX, corners_uv.max(axis=1) + _ROUNDING_PX
        near = wanted.near(low, high)
        corners, low, high = points[faces[near]], low[near], high[near]
        at_once = max(1, _PAIRS_AT_ONCE // max(1, len(corners)))
        for part in np.array_split(np.flatnonzero(usable), max(1, -(-int(usable.sum()) // at_once))):
            within = (low[None] <= uv[part, None]) & (uv[part, None] <= high[None])
            which, triangle = np.nonzero(within.all(axis=-1))
            hit = _hit_distance(rays[part[which]], corners[triangle])
            np.minimum.at(distance, part[which], hit)
    distance[~np.isfinite(distance)] = np.nan
    return distance * (rays[:, 2] if isinstance(camera, Camera) else 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Wanted:
    """Where positions lie in a picture, by squares of a few pixels: their summed-area table."""

    table: NDArray[np.int64]

    @staticmethod
    def of(camera: CameraModel, uv: FloatArray) -> _Wanted:
        columns, rows = (-(-n // _SQUARE_PX) for n in camera.size)
        at = np.clip(np.rint(uv) // _SQUARE_PX, 0, [columns - 1, rows - 1]).astype(np.int64)
        counts = np.zeros((rows, columns), np.int64)
        np.add.at(counts, (at[:, 1], at[:, 0]), 1)
        return _Wanted(np.pad(counts.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))))

    def near(self, low: FloatArray, high: FloatArray) -> NDArray[np.intp]:
        """Return the indices of the rectangles (F, 2) whose squares hold a position."""
        rows, columns = (n - 1 for n in self.table.shape)
        drawn: NDArray[np.bool_] = np.asarray((np.isfinite(low) & np.isfinite(high)).all(axis=1))
        first, last = (
            np.clip(np.where(drawn[:, None], corner, 0) // _SQUARE_PX + more, 0, [columns, rows]).astype(np.int64)
            for corner, more in ((low, -1), (high, 2))
        )
        (left, top), (right, bottom) = first.T, last.T
        table = self.table
        count = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
        return np.flatnonzero(drawn & (count > 0))


def _hit_distance(rays: FloatArray, corners: FloatArray) -> NDArray[np.float64]:
    """Return the distance (K,) of triangles (K, 3, 3) along unit rays (K, 3); infinity where they miss.

    Source: T. Moeller and B. Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997.
    """
    a = corners[:, 0]
    ab, ac = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(rays, ac)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.einsum("ij,ij->i", ab, p)
        u = -np.einsum("ij,ij->i", a, p) * scale
        q = np.cross(-a, ab)
        v = np.einsum("ij,ij->i", q, rays) * scale
        t = np.einsum("ij,ij->i", ac, q) * scale
        hit = (u >= -_BESIDE) & (v >= -_BESIDE) & (u + v <= 1 + _BESIDE) & (t > 0)
    return np.where(hit, t, np.inf)


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
    rows = max(1, _MOST_PIXELS // camera.width)
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
