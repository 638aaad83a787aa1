"""Renders a scan's own colours from another camera position: photographs with an exactly known pose."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, cube_faces
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.palette import paint
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges, scan_mesh
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.visibility.occluding_surface import coarse_mesh
from ladarreg_core.surface.visibility.rasterise import covering_pinhole, rasterise_values
from ladarreg_core.surface.visibility.visible_points import without_cracks

_MAP_BLOCK_PX = 4
_BACKGROUND = (128, 128, 128)
_SAME_SURFACE = 0.02  # relative change of the depth within one pixel
LARGEST_DRAWN_SCAN = 2_000_000
"""Cells; larger scans are thinned."""
_LARGEST_SUPERSAMPLE = 8


def render_scan_colors(
    scan: Scan,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    *,
    picture: ByteArray | None = None,
    supersample: int = 3,
    background: tuple[int, int, int] = _BACKGROUND,
) -> tuple[ByteArray, BoolArray]:
    """Render a scan's own colours, on its surface, as seen by another camera.

    Colours are linear over each triangle of the scan's mesh and averaged over the area of each pixel, so that the image
    is correct to a few hundredths of a pixel where the scan is.

    Args:
        scan: the scan.
        camera: the camera, with or without distortion.
        camera_from_scanner: its pose.
        picture: (H, W, 3) uint8 on the scan's grid; None: the scan's own colour.
        supersample: samples per pixel along each axis, 1 to 8.
        background: RGB where the scan has no surface.

    Returns:
        rgb (height, width, 3) uint8, and the pixels that the scan covers by at least half, (height, width) bool.

    Raises:
        ShapeError: if the scan has no colour and no image is given, or the image is not on the scan's grid.
        OptionError: if `supersample` is out of range.
    """
    own = scan.color if picture is None else picture
    if own is None:
        raise ShapeError("the scan has no colour of its own; give an image on its grid, or a scan with colour")
    texture = read_only(own, np.uint8, (*scan.shape, 3), "the image on the scan's grid")
    require_int(supersample, "supersample", least=1, most=_LARGEST_SUPERSAMPLE)
    if scan.ranges.size > LARGEST_DRAWN_SCAN:
        scan, stride = scan.thinned(LARGEST_DRAWN_SCAN)
        texture = texture[::stride, ::stride]
    mesh = scan_mesh(scan)
    values = texture[mesh.cells[:, 0], mesh.cells[:, 1]].astype(np.float32) / 255
    points_camera = camera_from_scanner @ mesh.vertices.astype(np.float64)
    pinhole = camera.as_pinhole
    if pinhole is None:
        return _render_wide(camera, points_camera, mesh.faces, values, background)
    ideal = covering_pinhole(pinhole, scale=supersample)
    depth, drawn = rasterise_values(points_camera, mesh.faces, values, ideal)
    covered = np.isfinite(depth).astype(np.float32)
    if pinhole.distortion:
        at = _ideal_positions(pinhole, ideal, supersample)
        drawn, covered = _resampled(drawn, at), _resampled(covered, at)
    color = cv2.resize(drawn, camera.size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(covered, camera.size, interpolation=cv2.INTER_AREA)
    color = color * 255 + (1 - share[..., None]) * np.array(background, dtype=np.float32)
    return np.clip(np.rint(color), 0, 255).astype(np.uint8), np.asarray(share >= 0.5)


def render_scan_picture(
    scan: Scan, camera: CameraModel, camera_from_scanner: Rigid, picture: ByteArray
) -> tuple[ByteArray, BoolArray]:
    """Render a picture of the scan, to be looked at, as seen by another camera, one sample a pixel.

    For a pinhole camera, the cell that each pixel shows is drawn on a mesh that is coarse where the scan is flat, and
    looked up in the picture: a third of the time of `render_scan_colors`, which is exact.

    Args:
        scan: the scan.
        camera: the camera, with or without distortion.
        camera_from_scanner: its pose.
        picture: (H, W, 3) uint8 on the scan's grid.

    Returns:
        rgb (height, width, 3) uint8, gray where the scan has no surface, and the pixels that it covers, bool.
    """
    pinhole = camera.as_pinhole
    if pinhole is None or scan.ranges.size > LARGEST_DRAWN_SCAN:
        return render_scan_colors(scan, camera, camera_from_scanner, picture=picture, supersample=1)
    vertices, faces, cells = coarse_mesh(scan)
    size = np.array([max(n - 1, 1) for n in scan.shape], np.float32)
    values = np.zeros((len(vertices), 3), np.float32)
    values[:, :2] = np.stack(np.divmod(cells.astype(np.int32), np.int32(scan.shape[1])), axis=-1) / size
    ideal = covering_pinhole(pinhole)
    depth, drawn = rasterise_values(camera_from_scanner @ vertices.astype(np.float64), faces, values, ideal)
    row, column = (np.ascontiguousarray(drawn[..., k]) for k in range(2))
    inverse = np.float32(1) / depth
    seen = inverse > 0
    # Between blocks of two sizes there are gaps, through which one sees what is behind, or nothing.
    gap = without_cracks(inverse) > np.float32(1 + _SAME_SURFACE) * inverse
    for plane, most in ((row, size[0]), (column, size[1])):
        plane[gap] = 0
        plane[gap] = without_cracks(plane)[gap]
        plane *= most
    on_surface = _cells_with_neighbours(scan)
    seen[gap] = on_surface[np.rint(row[gap]).astype(np.intp), np.rint(column[gap]).astype(np.intp)]
    color = look_up(_continued(picture, on_surface), column, row)
    paint(color, ~seen, _BACKGROUND)
    if pinhole.distortion:
        at = _ideal_positions(pinhole, ideal, 1)
        u, v = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        color = look_up(color, u, v, outside=_BACKGROUND)
        seen = _resampled(seen.astype(np.float32), at) >= 0.5
        paint(color, ~seen, _BACKGROUND)
    return color, seen


def _cells_with_neighbours(scan: Scan) -> BoolArray:
    """Return the cells (H, W) with two neighbours on the same surface: all but those without return and spikes."""
    edges, count = grid_edges(scan), np.zeros(scan.shape, np.uint8)
    count[:, 1:] += edges.right
    count[:, :-1] += edges.right
    count[1:] += edges.down
    count[:-1] += edges.down
    return np.asarray(count >= 2)


def _continued(picture: ByteArray, known: BoolArray) -> ByteArray:
    """Return a picture (H, W, 3) with unknown cells as their known neighbours are on average, for interpolation."""
    square = (3, 3)
    count = cv2.boxFilter(known.astype(np.float32), cv2.CV_32F, square, normalize=False)
    beside = ~known & (count > 0)
    total = cv2.boxFilter(cv2.copyTo(picture, known.view(np.uint8)), cv2.CV_32F, square, normalize=False)
    result = picture.copy()
    result[beside] = np.rint(total[beside] / count[beside][:, None])
    return result


def _render_wide(
    camera: CameraModel,
    points_camera: FloatArray,
    faces: IntArray,
    values: FloatArray,
    background: tuple[int, int, int],
) -> tuple[ByteArray, BoolArray]:
    """Render into a wide image, one sample a pixel, by way of the faces of a cube around the camera."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u, v], axis=-1)).astype(np.float32)
    color = np.empty((camera.height, camera.width, 3), dtype=np.float32)
    color[:] = background
    covered = np.zeros((camera.height, camera.width), dtype=np.bool_)
    for face in cube_faces(camera):
        turned = rays @ face.face_from_camera.T.astype(np.float32)
        here = face.holds(turned)
        depth, drawn = rasterise_values(points_camera @ face.face_from_camera.T, faces, values, face.camera)
        at = np.where(here[..., None], face.camera.project(turned), np.float32(-10))
        found = here & (_resampled(np.isfinite(depth).astype(np.float32), at) >= 0.5)
        color[found] = (_resampled(drawn, at) * 255)[found]
        covered |= found
    return np.clip(np.rint(color), 0, 255).astype(np.uint8), covered


def _resampled(image: NDArray[np.float32], at: FloatArray) -> NDArray[np.float32]:
    u, v = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), dtype=np.float32)


def _ideal_positions(camera: Camera, ideal: Camera, supersample: int) -> NDArray[np.float32]:
    """Return the position of each sample of a distorted image in the ideal one, (H s, W s, 2) float32 pixels.

    The distortion is inverted at the centres of blocks of 4 x 4 pixels and interpolated between them, to .01 px.
    """
    block = _MAP_BLOCK_PX
    counts = [-(-n // block) + 2 for n in camera.size]  # one block beyond each border
    u, v = ((np.arange(n) - 0.5) * block - 0.5 for n in counts)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    with np.errstate(invalid="ignore"):
        nodes = (rays[..., :2] / rays[..., 2:]) * (ideal.fx, ideal.fy) + (ideal.cx, ideal.cy)
    nodes = np.where(np.isfinite(nodes), nodes, -1e4).astype(np.float32)
    fine = block * supersample
    at = cv2.resize(nodes, (counts[0] * fine, counts[1] * fine), interpolation=cv2.INTER_LINEAR)
    return np.asarray(at[fine : fine + camera.height * supersample, fine : fine + camera.width * supersample])
