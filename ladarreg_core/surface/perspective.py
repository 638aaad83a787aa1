"""The perspective view: the scan's intensity as seen by a camera at the scanner."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.validation import require_type
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_window import grid_rays
from ladarreg_core.surface.ranges import EDGE_FRACTION
from ladarreg_core.surface.remap import look_up

WIDEST_VIEW_RAD = np.deg2rad(120.0)
"""Largest field of view of a perspective image."""
_NODE_PX = 8
_ROWS_AT_ONCE = 256
_LARGEST_WHOLE_SCAN = 4_000_000
_OUTSIDE = -1e4
_LONGEST_SIDE = 32_000
_MAX_PIXELS = 100_000_000
_MAX_PIXELS_PER_CELL = 16
_MIN_SHOWN_PX = 8
_LARGEST_FOCAL_PX = 1e12


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole image of the scan, from the scanner's own centre."""

    scan: Scan
    """The scan shown."""
    camera: Camera
    """The camera, without distortion."""
    view_from_scanner: Rigid
    """A pure rotation: with a shared centre, straight lines stay straight and rays stay rays."""
    intensity: FloatArray
    """(h, w) float32, bilinear; 0 outside the grid."""
    cells: FloatArray
    """(h, w, 2) float32, the fractional (column, row) of each pixel, in the order of `cv2.remap`; far outside the grid
    for pixels that look past it."""

    @cached_property
    def inside(self) -> BoolArray:
        """(h, w) bool: pixels inside the scan's grid."""
        height, width = self.scan.shape
        column, row = self.cells[..., 0], self.cells[..., 1]
        return np.asarray((column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1))

    def resample(self, values: FloatArray) -> FloatArray:
        """Return values (H, W) float32 of the scan's grid at the view's pixels (h, w), bilinear; 0 outside the grid."""
        return np.asarray(_values_at(values, self.cells, cv2.INTER_LINEAR))

    def resample_ranges(self, ranges: FloatArray) -> FloatArray:
        """Return ranges (H, W) m at the view's pixels, (h, w) float32; NaN = no return.

        Bilinear inside a surface; the nearest cell at depth edges and beside holes, so that no ranges between
        foreground and background arise.
        """
        filled = np.where(np.isfinite(ranges), ranges, np.float32(0)).astype(np.float32, copy=False)
        smooth = np.zeros(filled.shape, np.uint8)
        for first in range(0, len(filled) - 1, _ROWS_AT_ONCE):
            band = filled[first : first + _ROWS_AT_ONCE + 1]
            corners = band[:-1, :-1], band[:-1, 1:], band[1:, :-1], band[1:, 1:]
            low, high = reduce(np.minimum, corners), reduce(np.maximum, corners)
            smooth[first : first + len(low), :-1] = (low > 0) & (high - low < EDGE_FRACTION * low)
        linear, nearest = self.resample(filled), _values_at(filled, self.cells, cv2.INTER_NEAREST)
        # A quad is identified by its upper left cell: floor, not round.
        quad = _values_at(smooth, np.floor(self.cells), cv2.INTER_NEAREST)
        result = np.where(quad > 0, linear, nearest)
        return np.where(result > 0, result, np.nan).astype(np.float32)

    @cached_property
    def ranges(self) -> FloatArray:
        """(h, w) float32 m, NaN = no return."""
        return self.resample_ranges(self.scan.ranges)

    def of_window(self, *, margin: int, most_cells: int) -> View:
        """Return the same view of the part of the scan that it shows, thinned to at most about `most_cells`.

        Args:
            margin: cells around that part.
            most_cells: largest number of cells.
        """
        seen = self.cells[self.inside]
        if not len(seen):
            return self
        parts = []
        for k, size in enumerate(self.scan.shape):
            across = seen[:, 1 - k]
            first = max(0, int(across.min()) - margin)
            parts.append(slice(first, min(size, max(int(across.max()) + margin + 2, first + 2))))
        count = (parts[0].stop - parts[0].start) * (parts[1].stop - parts[1].start)
        step = max(1, int(np.ceil(np.sqrt(count / most_cells))))
        rows, columns = (slice(part.start, part.stop, step) for part in parts)
        try:
            scan = self.scan.window(rows, columns)
        except ShapeError:  # without returns
            return self
        first_cell = np.array([columns.start, rows.start], np.float32)
        return replace(self, scan=scan, cells=(self.cells - first_cell) / np.float32(step))

    def rays_at(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3), scanner frame, of view pixels (..., 2)."""
        return np.asarray(self.camera.unproject(uv) @ self.view_from_scanner.rotation)

    def project(self, rays: ArrayLike) -> FloatArray:
        """Return the view pixels (..., 2) of rays (..., 3), scanner frame; NaN behind the view."""
        return self.camera.project(np.asarray(rays) @ self.view_from_scanner.rotation.T)


def perspective_view(
    scan: Scan,
    camera: Camera | None = None,
    *,
    whole_scan: bool = False,
    view_from_scanner: Rigid | None = None,
    most_pixels: int = _MAX_PIXELS,
) -> View:
    """Return the scan's intensity as a perspective view.

    Args:
        scan: the scan.
        camera: focal length and size of the image, normally the photo's; distortion is ignored, and the principal
            point moved to the middle. None: one pixel per cell, wide enough for the whole scan, but coarser if it
            would have more than 16 times the scan's cells, 32,000 pixels a side, or `most_pixels`: a grid that is
            finer in one direction than in the other has more pixels than cells.
        whole_scan: widen the image until it contains every return, up to 120 degrees in each direction.
        view_from_scanner: viewing direction; the translation must be zero. None: along the mean direction of the
            returns, without roll.
        most_pixels: limit of a view without `camera`.

    Returns:
        The view, filled by inverse mapping. Pixels outside the grid have intensity 0.

    Raises:
        OptionError: if `view_from_scanner` moves the centre, or the view would have more than 100 Mpixel or 32,000
            pixels a side.
        DegenerateGeometryError: if no camera is given and the scan's rays do not spread, or so little in one direction
            that no image of this many pixels resolves its rows and columns.

    Source: thesis 2.2.2, Eq 2.2-2.5.
    """
    require_type(scan, Scan, "'scan'")
    if camera is not None:
        require_type(camera, Camera, "'camera'")
    if view_from_scanner is not None and np.abs(view_from_scanner.translation).max() > 1e-9:
        raise OptionError("the view is not from the scanner's centre; its transform must be a pure rotation")
    pose = view_from_scanner or Rigid(look_along(scan.mean_direction), np.zeros(3))
    if camera is None:
        ideal = _native_camera(scan, pose, most_pixels)
    else:
        ideal = Camera.from_focal(camera.width, camera.height, camera.focal_px)
        if whole_scan:
            ideal = _widened(ideal, _extent(scan, pose))
    if ideal.width * ideal.height > _MAX_PIXELS or max(ideal.size) > _LONGEST_SIDE:
        raise OptionError(
            f"the view would have {ideal.width:,} x {ideal.height:,} pixels; at most {_MAX_PIXELS:,}, and "
            f"{_LONGEST_SIDE:,} a side, are supported: use a smaller image or a shorter focal length"
        )
    cells = _cell_maps(scan, ideal, pose)
    return View(scan, ideal, pose, _values_at(scan.intensity, cells, cv2.INTER_LINEAR), cells)


def native_focal_px(scan: Scan) -> float:
    """Return the focal length, px, at which a view has one pixel per cell in the scan's finer direction.

    Raises:
        DegenerateGeometryError: if the scan's rays do not spread in both directions.
    """
    finest = min(scan.geometry.step_rad)
    if not (np.isfinite(finest) and finest > 0):
        raise DegenerateGeometryError(
            f"the scan's neighbouring rays are {finest:g} rad apart; they must spread along rows and columns: check "
            "the scan's angles or points"
        )
    return float(min(1 / finest, _LARGEST_FOCAL_PX))


def most_view_pixels(scan: Scan) -> int:
    """Return the limit of pixels for a view of a scan: 16 per cell; more would only repeat its cells."""
    return _MAX_PIXELS_PER_CELL * scan.ranges.size


def check_viewable(scan: Scan, focal_px: float) -> None:
    """Raise an error if a focal length, coarser than a pixel per cell, leaves too few pixels for rows or columns.

    Raises:
        DegenerateGeometryError: if a direction of more than 8 cells has fewer than 8 pixels.
    """
    spans = [cells * step for cells, step in zip(scan.shape, scan.geometry.step_rad, strict=True)]
    if any(span * focal_px < min(_MIN_SHOWN_PX, cells) for span, cells in zip(spans, scan.shape, strict=True)):
        rows, columns = np.degrees(spans)
        raise DegenerateGeometryError(
            f"the scan's {scan.shape[0]} rows span {rows:.3g} deg and its {scan.shape[1]} columns {columns:.3g} deg, "
            "which no single image resolves; check the file's angles per row and per column"
        )


def _native_camera(scan: Scan, view_from_scanner: Rigid, most_pixels: int) -> Camera:
    """Return a camera that sees the whole scan at one pixel per cell, or as finely as the limits allow."""
    most = min(most_pixels, most_view_pixels(scan))
    extent, native = _extent(scan, view_from_scanner), native_focal_px(scan)
    focal = native
    while True:
        camera = _widened(Camera.from_focal(2, 2, focal), extent)
        share = min(np.sqrt(most / (camera.width * camera.height)), _LONGEST_SIDE / max(camera.size))
        if share >= 1:
            break
        focal *= min(float(share), 0.999)  # sizes are rounded up
        check_viewable(scan, focal)
    return camera


def _extent(scan: Scan, view_from_scanner: Rigid) -> tuple[float, float]:
    """Return the horizontal and vertical extent of the returns in front, as tangents, within 120 degrees."""
    limit = float(np.tan(WIDEST_VIEW_RAD / 2))
    most = [0.0, 0.0]
    height = scan.shape[0] if scan.ranges.size <= _LARGEST_WHOLE_SCAN else _ROWS_AT_ONCE
    for first in range(0, scan.shape[0], height):
        band = slice(first, first + height)
        whole = height == scan.shape[0]
        rays = scan.rays if whole else grid_rays(scan.geometry, band, slice(None))
        rays = rays[scan.valid[band]] @ view_from_scanner.rotation.T
        rays = rays[rays[:, 2] > np.cos(WIDEST_VIEW_RAD / 2) * 0.5]
        most = [max(most[k], float(np.abs(rays[:, k] / rays[:, 2]).max(initial=0.0))) for k in (0, 1)]
    return min(most[0], limit), min(most[1], limit)


def _widened(camera: Camera, extent: tuple[float, float]) -> Camera:
    """Enlarge the image, at the same focal length, to an extent given as tangents."""
    width = max(camera.width, int(np.ceil(2 * extent[0] * camera.fx)) + 1)
    height = max(camera.height, int(np.ceil(2 * extent[1] * camera.fy)) + 1)
    return Camera.from_focal(width, height, camera.focal_px)


def _cell_maps(scan: Scan, camera: Camera, view_from_scanner: Rigid) -> FloatArray:
    """Return (h, w, 2) float32 (column, row): exact at nodes eight pixels apart, linear between.

    The error between nodes is below .01 cell, less than the 1/32 to which `cv2.remap` rounds coordinates.
    """
    # A resize by n puts node k at pixel n k + (n - 1)/2; an extra node on each side avoids extrapolation.
    columns, rows = -(-camera.width // _NODE_PX) + 2, -(-camera.height // _NODE_PX) + 2
    offset = (_NODE_PX - 1) / 2 - _NODE_PX
    u, v = (np.arange(n, dtype=np.float32) * _NODE_PX + np.float32(offset) for n in (columns, rows))
    nodes = _columns_rows(scan, camera, view_from_scanner, *np.meshgrid(u, v))
    size = (columns * _NODE_PX, rows * _NODE_PX)
    dense = np.asarray(cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    cells: FloatArray = dense[_NODE_PX : _NODE_PX + camera.height, _NODE_PX : _NODE_PX + camera.width]
    broken = _broken_between_nodes(nodes, 0.25 * max(scan.shape))
    if broken.any():
        # Nearest neighbours mark the pixels from the first node of a quad on; the quad reaches one node further.
        reach = np.ones((_NODE_PX + 1, _NODE_PX + 1), np.uint8)
        exact = cv2.dilate(cv2.resize(broken.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), reach)
        y, x = np.nonzero(exact[_NODE_PX : _NODE_PX + camera.height, _NODE_PX : _NODE_PX + camera.width])
        cells = np.ascontiguousarray(cells)
        cells[y, x] = _columns_rows(scan, camera, view_from_scanner, x.astype(np.float32), y.astype(np.float32))
    if broken.any() or not np.isfinite(nodes).all():  # also if the lens or table covers nothing here
        cells = np.nan_to_num(cells, nan=_OUTSIDE)
    return cells


def _values_at(values: NDArray[Any], cells: FloatArray, interpolation: int) -> NDArray[Any]:
    """Return values (H, W) of a grid at (h, w, 2) fractional (column, row); 0 outside."""
    if max(values.shape) > _LONGEST_SIDE:  # cv2.remap refuses such grids
        at = np.rint(cells) if interpolation == cv2.INTER_NEAREST else cells
        return look_up(values, at[..., 0], at[..., 1], outside=(0.0,))
    both_coordinates: Any = None
    return np.asarray(cv2.remap(values, cells, both_coordinates, interpolation))


def _broken_between_nodes(nodes: FloatArray, jump: float) -> BoolArray:
    """Return the nodes (rows, columns) between which and a neighbour no interpolation is possible.

    These are at the edge of a lens or table (NaN on one side only) and at the seam of a full turn.
    """
    steps = [nodes[1:] - nodes[:-1], nodes[:, 1:] - nodes[:, :-1]]
    if all(step.max() < jump and step.min() > -jump for step in steps):  # false for NaN, too
        return np.zeros(nodes.shape[:2], np.bool_)
    known = np.asarray(np.isfinite(nodes).all(axis=-1))
    filled = np.where(known[..., None], nodes, np.float32(-4 * jump)).astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    planes = [np.ascontiguousarray(filled[..., k]) for k in (0, 1)]
    spans = [np.asarray(cv2.dilate(p, square)) - np.asarray(cv2.erode(p, square)) for p in planes]
    some = np.asarray(cv2.dilate(np.asarray(known, np.uint8), square)) > 0
    return np.asarray(some & ((spans[0] > jump) | (spans[1] > jump)))


def _columns_rows(scan: Scan, camera: Camera, view_from_scanner: Rigid, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return (..., 2) float32 (column, row) of view pixels u and v (...,)."""
    x, y = (u - np.float32(camera.cx)) / np.float32(camera.fx), (v - np.float32(camera.cy)) / np.float32(camera.fy)
    in_view = np.empty((*x.shape, 3), np.float32)
    in_view[..., 0], in_view[..., 1], in_view[..., 2] = x, y, 1
    directions = (in_view.reshape(-1, 3) @ view_from_scanner.rotation.astype(np.float32)).reshape(in_view.shape)
    return np.ascontiguousarray(scan.geometry.cell_of(directions)[..., ::-1], dtype=np.float32)
