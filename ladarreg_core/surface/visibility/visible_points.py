"""Visibility of a scan's cells from a camera, tested against the scan's surface and not its points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, Face, cube_faces
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges
from ladarreg_core.surface.mesh.normals import length_of
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.visibility.occluding_surface import Surface, surface_of
from ladarreg_core.surface.visibility.rasterise import covering_pinhole, rasterise_depth

_TOLERANCE_RELATIVE = 0.004
_TOLERANCE_SIGMAS = 4.0
_MIN_COSINE = 0.15
_GRAZING_COSINE = float(np.cos(np.deg2rad(80)))
LARGEST_WHOLE_SCAN = 4_000_000
"""Cells of the largest scan that is projected in one piece; larger ones are projected tile by tile."""
_TILE_ROWS, _TILE_CELLS, _TILE_MARGIN = 512, 1_500_000, 32
_SAMPLE_STRIDE = 4  # cells
_BESIDE_PICTURE = 0.2
_BUFFER_PIXELS = 900_000  # per million cells
_LONGEST_BUFFER_SIDE = 30_000
_COARSEST_BUFFER, _FINEST_BUFFER = 0.125, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class ScanProjection:
    """Projection of a scan's cells into a camera's image, with their visibility."""

    uv: FloatArray
    """(H, W, 2) float32, pixels; NaN without a return or behind the camera."""
    depth_m: FloatArray
    """(H, W) float32, z in the camera frame, of a wide camera the distance from it; NaN = no return."""
    in_picture: BoolArray
    """(H, W) bool."""
    occluded: BoolArray
    """(H, W) bool: in the image, but hidden by the surface or facing away."""
    untested: BoolArray
    """(H, W) bool: in the image, but too far off the axis for the occlusion test."""
    cosine: FloatArray
    """(H, W) float32: cosine of the incidence angle of the camera's ray on the surface; negative if it faces away."""

    @property
    def grazing(self) -> BoolArray:
        """(H, W) bool: seen by the camera at an incidence beyond 80 degrees."""
        with np.errstate(invalid="ignore"):
            return self.in_picture & ~self.occluded & (self.cosine < _GRAZING_COSINE)

    @property
    def visible(self) -> BoolArray:
        """(H, W) bool: in the image and not occluded."""
        return self.in_picture & ~self.occluded

    def of_cells(self, rows: slice, columns: slice) -> ScanProjection:
        """Return the projection of some rows and columns."""
        part = rows, columns
        return ScanProjection(
            self.uv[part],
            self.depth_m[part],
            self.in_picture[part],
            self.occluded[part],
            self.untested[part],
            self.cosine[part],
        )


# The texture and the assessment of a pose ask for the same projection: the latest one is kept as long as its scan.
_latest: WeakKeyDictionary[Scan, tuple[CameraModel, Rigid, ScanProjection]] = WeakKeyDictionary()


def visible_cells(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> BoolArray:
    """Return the cells of a scan that a camera sees: (H, W) bool, see `project_scan`."""
    return project_scan(scan, camera, camera_from_scanner).visible


def project_scan(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> ScanProjection:
    """Project a scan into a camera's image and find the occluded cells.

    The scan's surface is drawn into a z-buffer about as fine as the scan's cells. There is no surface across depth
    edges, and the near side of an edge extends half a cell beyond its last cell centre, so that thin objects occlude
    what is behind them. The buffer is read in inverse depth, which is linear on planes, so that slopes do not shadow
    themselves.

    Args:
        scan: the scan; everything that does not depend on the pose is cached for its lifetime.
        camera: the camera, with or without distortion.
        camera_from_scanner: its pose.

    Returns:
        The projection; its arrays are read-only.
    """
    if scan.ranges.size > LARGEST_WHOLE_SCAN:
        return _projection_by_tiles(scan, camera, camera_from_scanner)
    latest = _latest.get(scan)
    if latest is not None and latest[0] is camera and latest[1] is camera_from_scanner:
        return latest[2]
    found = _projection(scan, camera, camera_from_scanner, None)
    for array in (found.uv, found.depth_m, found.in_picture, found.occluded, found.untested, found.cosine):
        array.flags.writeable = False
    _latest.clear()
    _latest[scan] = camera, camera_from_scanner, found
    return found


class Occluder:
    """The surface of a scan as a camera sees it: whether it hides points that need not be cells of the scan.

    Args:
        scan: the scan.
        camera: the camera.
        camera_from_scanner: its pose.
    """

    def __init__(self, scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> None:
        self._camera, self._pose = camera, camera_from_scanner
        if scan.ranges.size <= LARGEST_WHOLE_SCAN:
            surfaces: Iterable[Surface] = (surface_of(scan),)
        else:
            places = places_in_picture(scan, camera, camera_from_scanner)
            surfaces = _surfaces_of(scan, places)
        self._noise_m = grid_edges(scan).noise_m
        self._buffers = _depth_buffers(
            camera, _sampled_buffer_scale(scan, camera, camera_from_scanner), surfaces, camera_from_scanner
        )

    def hides(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 3) of the scanner frame, m, the surface hides from the camera, (N,) bool.

        A point on the surface is not hidden; neither is one outside of the picture, or without a surface before it.
        """
        points_camera = (self._pose @ np.asarray(points, dtype=np.float64)).astype(np.float32)
        facing = np.ones(len(points_camera), np.float32)  # the incidence of a single point is not known
        noise_m = np.float32(_TOLERANCE_SIGMAS * self._noise_m)
        hidden = np.zeros(len(points_camera), np.bool_)
        for buffer in self._buffers:
            turned = points_camera
            if buffer.face is not None:
                turned = points_camera @ buffer.face.face_from_camera.T.astype(np.float32)
            at = np.clip(np.nan_to_num(buffer.ideal.project(turned), nan=-1e4), -1e4, 1e5).astype(np.float32)
            u, v = np.ascontiguousarray(at[None, :, 0]), np.ascontiguousarray(at[None, :, 1])
            behind = _is_behind(turned[:, 2], look_up(buffer.inverse, u, v)[0], facing, noise_m)
            hidden |= behind if buffer.face is None else behind & buffer.face.holds(turned)
        return hidden


def _surfaces_of(scan: Scan, places: Iterable[tuple[slice, slice]]) -> Iterator[Surface]:
    for place in places:
        try:
            yield surface_of(scan.window(*_with_margin(*place, scan.shape)))
        except ShapeError:  # without returns
            continue


@dataclass(frozen=True, slots=True, eq=False)
class ScanTile:
    """A rectangle of a scan, with its projection."""

    rows: slice
    """Rows of the scan."""
    columns: slice
    """Columns of the scan."""
    scan: Scan
    """The tile with a margin of cells around it."""
    projection: ScanProjection
    """Projection of the tile with its margin."""
    inner: tuple[slice, slice]
    """The tile within its margin."""


def projected_tiles(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> Iterator[ScanTile]:
    """Yield the parts of a scan that a camera may see, projected as by `project_scan`; the others are out of frame.

    The z-buffer contains the surface of all of them, so that memory does not grow with the scan.
    """
    places = places_in_picture(scan, camera, camera_from_scanner)
    if not places:
        return
    kept: dict[tuple[int, int], Scan] = {}
    keep = sum(_cells(*place) for place in places) <= LARGEST_WHOLE_SCAN

    def tile(rows: slice, columns: slice) -> Scan | None:
        known = kept.get((rows.start, columns.start))
        if known is None:
            try:
                known = scan.window(*_with_margin(rows, columns, scan.shape))
            except ShapeError:  # without returns
                return None
            if keep:
                kept[rows.start, columns.start] = known
        return known

    scale = _sampled_buffer_scale(scan, camera, camera_from_scanner)
    parts = (tile(*place) for place in places)
    buffers = _depth_buffers(
        camera, scale, (surface_of(part) for part in parts if part is not None), camera_from_scanner
    )
    for rows, columns in places:
        part = tile(rows, columns)
        if part is not None:
            outer = _with_margin(rows, columns, scan.shape)
            inner = tuple(
                slice(a.start - b.start, a.stop - b.start) for a, b in zip((rows, columns), outer, strict=True)
            )
            projection = _projection(part, camera, camera_from_scanner, buffers)
            yield ScanTile(rows, columns, part, projection, (inner[0], inner[1]))
        kept.pop((rows.start, columns.start), None)


@dataclass(frozen=True, slots=True, eq=False)
class _DepthBuffer:
    """The nearest surface in the picture of an ideal camera, or in a face of the cube around a wide one."""

    ideal: Camera
    inverse: FloatArray
    """(h, w) float32: 1 / z."""
    face: Face | None = None


def _depth_buffers(
    camera: CameraModel, scale: float, surfaces: Iterable[Surface], camera_from_scanner: Rigid
) -> tuple[_DepthBuffer, ...]:
    """Draw the occluding surfaces: once for a pinhole, and for a wide camera into each face of the cube around it."""
    pinhole = camera.as_pinhole
    faces = () if pinhole is not None else cube_faces(camera, scale=scale)
    pictures = [f.camera for f in faces] if pinhole is None else [covering_pinhole(pinhole, scale=scale)]
    depths = [np.full((picture.height, picture.width), np.inf, np.float32) for picture in pictures]
    for surface in surfaces:
        vertices = camera_from_scanner @ surface.vertices
        for k, picture in enumerate(pictures):
            turned = vertices @ faces[k].face_from_camera.T if faces else vertices
            np.minimum(depths[k], rasterise_depth(turned, surface.faces, picture), out=depths[k])
    return tuple(
        _DepthBuffer(picture, without_cracks(np.float32(1) / depth), faces[k] if faces else None)
        for k, (picture, depth) in enumerate(zip(pictures, depths, strict=True))
    )


def _projection(
    scan: Scan, camera: CameraModel, camera_from_scanner: Rigid, buffers: tuple[_DepthBuffer, ...] | None
) -> ScanProjection:
    """Project a scan; `buffers` are the occluding surface, None: that of the scan itself."""
    surface = surface_of(scan)
    points_camera = _transformed(surface.points, camera_from_scanner)
    depth = camera.depth_of(points_camera)
    uv = camera.project(points_camera)
    in_picture = camera.contains(uv)
    shape = scan.shape
    if not in_picture.any():
        none = np.zeros(shape, dtype=np.bool_)
        return ScanProjection(uv, depth, in_picture, none, none, np.zeros(shape, dtype=np.float32))
    cosine = _cosine(surface, points_camera, camera_from_scanner.centre)

    if buffers is None:
        scale = _buffer_scale(scan, camera, depth, in_picture)
        buffers = _depth_buffers(camera, scale, (surface,), camera_from_scanner)
    noise_m = np.float32(_TOLERANCE_SIGMAS * surface.edges.noise_m)
    untested = np.zeros(shape, dtype=np.bool_)
    hidden: BoolArray
    pinhole = camera.as_pinhole
    if pinhole is not None:
        ideal = buffers[0].ideal
        u, v = _ideal_uv(points_camera, uv, pinhole, ideal)
        hidden = _is_behind(depth, look_up(buffers[0].inverse, u, v), cosine, noise_m)
        if pinhole.distortion:
            untested = in_picture & ~_within(u, v, ideal)
    else:
        hidden = np.zeros(shape, dtype=np.bool_)
        for buffer in buffers:
            assert buffer.face is not None
            points = points_camera @ buffer.face.face_from_camera.T.astype(np.float32)
            at = np.nan_to_num(buffer.ideal.project(points), nan=-1e4)
            nearest = look_up(buffer.inverse, np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1]))
            hidden |= buffer.face.holds(points) & _is_behind(points[..., 2], nearest, cosine, noise_m)
    occluded = in_picture & (hidden | (cosine < np.float32(-_GRAZING_COSINE)))
    return ScanProjection(uv, depth, in_picture, occluded, untested, cosine)


def _is_behind(depth: FloatArray, nearest: FloatArray, cosine: FloatArray, noise_m: np.float32) -> BoolArray:
    """Return whether points lie behind a surface whose inverse depth is `nearest`, beyond the tolerance."""
    with np.errstate(invalid="ignore"):
        # z > z_surface + tolerance, with z_surface = 1 / nearest; the tolerance grows as the surface tilts away.
        excess = (depth * nearest - 1) * np.maximum(np.abs(cosine), np.float32(_MIN_COSINE))
        return np.asarray(excess > np.float32(_TOLERANCE_RELATIVE) + noise_m * nearest)


def _projection_by_tiles(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> ScanProjection:
    shape = scan.shape
    uv = np.full((*shape, 2), np.nan, np.float32)
    depth = np.full(shape, np.nan, np.float32)
    cosine = np.zeros(shape, np.float32)
    flags = {name: np.zeros(shape, np.bool_) for name in ("in_picture", "occluded", "untested")}
    for tile in projected_tiles(scan, camera, camera_from_scanner):
        here = tile.rows, tile.columns
        uv[here] = tile.projection.uv[tile.inner]
        depth[here] = tile.projection.depth_m[tile.inner]
        cosine[here] = tile.projection.cosine[tile.inner]
        for name, flag in flags.items():
            flag[here] = getattr(tile.projection, name)[tile.inner]
    return ScanProjection(uv, depth, flags["in_picture"], flags["occluded"], flags["untested"], cosine)


def places_in_picture(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> list[tuple[slice, slice]]:
    """Return rectangles (rows, columns) that contain all cells in the picture, without overlap, by a coarse sample."""
    stride = _SAMPLE_STRIDE
    uv = camera.project(camera_from_scanner @ scan.thinned_points(stride).astype(np.float64))
    near = np.ones(uv.shape[:2], np.bool_)
    with np.errstate(invalid="ignore"):
        for k, size in enumerate(camera.size):
            near &= (uv[..., k] > -_BESIDE_PICTURE * size) & (uv[..., k] < (1 + _BESIDE_PICTURE) * size)
    near = cv2.dilate(near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    found = []
    band = max(1, _TILE_ROWS // stride)
    for top in range(0, len(near), band):
        columns = np.flatnonzero(near[top : top + band].any(axis=0))
        if not len(columns):
            continue
        rows = slice(top * stride, min((top + band) * stride, scan.shape[0]))
        first, last = int(columns[0]) * stride, min((int(columns[-1]) + 1) * stride, scan.shape[1])
        wide = max(stride, _TILE_CELLS // (rows.stop - rows.start))
        found += [(rows, slice(at, min(at + wide, last))) for at in range(first, last, wide)]
    return found


def _cells(rows: slice, columns: slice) -> int:
    return int((rows.stop - rows.start) * (columns.stop - columns.start))


def _with_margin(rows: slice, columns: slice, shape: tuple[int, int]) -> tuple[slice, slice]:
    wider = (
        slice(max(0, part.start - _TILE_MARGIN), min(size, part.stop + _TILE_MARGIN))
        for part, size in zip((rows, columns), shape, strict=True)
    )
    first, second = wider
    return first, second


def _sampled_buffer_scale(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> float:
    """Return `_buffer_scale` from a coarse sample of the scan."""
    steps = [max(1, size // 200) for size in scan.shape]
    part = slice(None, None, steps[0]), slice(None, None, steps[1])
    points = camera_from_scanner @ scan.points_at(*part).astype(np.float64)
    seen = camera.contains(camera.project(points))
    if not seen.any():
        return 1.0
    depth = camera.depth_of(points)
    magnification = float(np.median(scan.ranges[part][seen] / depth[seen]))
    return _scale_of(scan, camera, magnification)


def _transformed(planes: FloatArray, camera_from_scanner: Rigid) -> FloatArray:
    """Return points, stored as planes (3, H, W), in the camera frame, viewed as (H, W, 3)."""
    rotated = camera_from_scanner.rotation.astype(np.float32) @ planes.reshape(3, -1)
    rotated += camera_from_scanner.translation.astype(np.float32)[:, None]
    return np.moveaxis(rotated.reshape(planes.shape), 0, -1)


def _cosine(surface: Surface, points_camera: FloatArray, centre: FloatArray) -> NDArray[np.float32]:
    """Return n . (centre - p) / |centre - p|."""
    along = (centre.astype(np.float32) @ surface.normals.reshape(3, -1)).reshape(surface.distance.shape)
    along -= surface.distance
    return np.asarray(along / length_of(np.moveaxis(points_camera, -1, 0)))


def _buffer_scale(scan: Scan, camera: CameraModel, depth: FloatArray, in_picture: BoolArray) -> float:
    """Return buffer pixels per photo pixel: about one pixel for the shorter side of a cell, within limits."""
    row, column = np.nonzero(in_picture[:: max(1, scan.shape[0] // 200), :: max(1, scan.shape[1] // 200)])
    row, column = row * max(1, scan.shape[0] // 200), column * max(1, scan.shape[1] // 200)
    if not len(row):
        return 1.0
    return _scale_of(scan, camera, float(np.median(scan.ranges[row, column] / depth[row, column])))


def _scale_of(scan: Scan, camera: CameraModel, magnification: float) -> float:
    cell_px = camera.focal_px * min(scan.geometry.step_rad) * magnification
    most = _BUFFER_PIXELS * max(1.0, scan.ranges.size / 1e6)
    finest = min(np.sqrt(most / (camera.width * camera.height)), _LONGEST_BUFFER_SIDE / max(camera.size))
    return float(min(max(1 / max(cell_px, 1e-6), _COARSEST_BUFFER), _FINEST_BUFFER, finest))


def _ideal_uv(
    points_camera: FloatArray, uv: FloatArray, camera: Camera, ideal: Camera
) -> tuple[FloatArray, FloatArray]:
    """Return the positions of points in the buffer, two (H, W) arrays; far outside for points that are not in it."""
    if camera.distortion:
        at = ideal.project(points_camera)
        at[np.isnan(uv[..., 0])] = np.nan
    else:
        at = uv
    result = []
    for k, (f_from, c_from, f_to, c_to) in enumerate(
        ((camera.fx, camera.cx, ideal.fx, ideal.cx), (camera.fy, camera.cy, ideal.fy, ideal.cy))
    ):
        scale = 1.0 if camera.distortion else f_to / f_from
        shift = 0.0 if camera.distortion else c_to - c_from * scale
        position = at[..., k] * np.float32(scale) + np.float32(shift)
        result.append(np.fmin(np.fmax(position, np.float32(-1e4)), np.float32(1e5)))  # NaN becomes a position outside
    return result[0], result[1]


def _within(u: FloatArray, v: FloatArray, camera: Camera) -> BoolArray:
    return np.asarray((u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5))


def without_cracks(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Close gaps (0) of one pixel: borders between blocks of two sizes agree only to the tolerance."""
    kernel = np.ones((2, 2), dtype=np.uint8)
    # Opposite anchors: with the same one twice, an even kernel would shift the image by a pixel.
    wider = cv2.dilate(picture, kernel, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.erode(wider, kernel, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
