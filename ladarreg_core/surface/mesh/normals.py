"""Normals of a scan's surface: from the slopes of its range, averaged over a window that suits its noise."""

from __future__ import annotations

from itertools import pairwise
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import GridEdges, grid_edges, typical_range

_SLOPE_NOISE = 0.05
_WIDEST_SLOPE_WINDOW = 5
_MARGIN = _WIDEST_SLOPE_WINDOW + 2
_CELLS_AT_ONCE = 1_500_000
_normals_of_scan: WeakKeyDictionary[Scan, NDArray[np.float32]] = WeakKeyDictionary()


def cell_normals(scan: Scan, cells: IntArray) -> NDArray[np.float32]:
    """Return the surface's unit normals, toward the scanner, at cells with a return.

    Args:
        scan: the scan; large ones are processed in bands of rows.
        cells: (N, 2) (row, column).

    Returns:
        normals (N, 3) float32, scanner frame.
    """
    kept = _normals_of_scan.get(scan)
    if kept is not None:
        flat = cells[:, 0].astype(np.intp) * scan.shape[1] + cells[:, 1]
        return np.stack([plane.take(flat) for plane in kept], axis=-1)
    height = scan.shape[0]
    edges = grid_edges(scan)
    result = np.zeros((len(cells), 3), np.float32)
    rows = _rows_at_once(scan)
    band_of = cells[:, 0] // rows
    order = np.argsort(band_of, kind="stable")
    starts = np.searchsorted(band_of[order], np.arange(0, height // rows + 2))
    for band, (first, last) in enumerate(pairwise(starts)):
        if first == last:
            continue
        outer = slice(max(0, band * rows - _MARGIN), min(height, (band + 1) * rows + _MARGIN))
        try:
            part = scan.window(outer, slice(None))
        except ShapeError:  # a last band of a single row
            outer = slice(max(0, outer.start - 1), outer.stop)
            part = scan.window(outer, slice(None))
        near = GridEdges(edges.right[outer], edges.down[outer.start : outer.stop - 1], edges.noise_m)
        rays = np.ascontiguousarray(np.moveaxis(part.rays, -1, 0), dtype=np.float32)
        normals = normals_of(rays, ray_gradients(rays), range_slopes(part, near))
        some = order[first:last]
        result[some] = normals[:, cells[some, 0] - outer.start, cells[some, 1]].T
    return result


def grid_normals(
    scan: Scan, rays: FloatArray, gradients: tuple[FloatArray, FloatArray], slopes: tuple[FloatArray, FloatArray]
) -> NDArray[np.float32]:
    """Return `normals_of` a whole scan, kept for `cell_normals` as long as the scan, unless that divides it."""
    normals = normals_of(rays, gradients, slopes)
    if scan.shape[0] <= _rows_at_once(scan):
        _normals_of_scan[scan] = normals
    return normals


def _rows_at_once(scan: Scan) -> int:
    return max(64, _CELLS_AT_ONCE // scan.shape[1])


def range_slopes(scan: Scan, edges: GridEdges) -> tuple[FloatArray, FloatArray]:
    """Return the change of ln(range) per (row, column), averaged over edges within one surface; 0 without any.

    The window grows with the noise, which would otherwise tilt the normals of a finely stepped scan.
    """
    with np.errstate(invalid="ignore"):
        log_range = np.log(scan.ranges)
    typical = typical_range(scan.ranges)
    slopes = []
    for axis, on_surface in ((0, edges.down), (1, edges.right)):
        step = np.where(on_surface, np.diff(log_range, axis=axis), np.float32(0))
        noise = edges.noise_m / (typical * max(scan.geometry.step_rad[axis], 1e-6))
        # Differences along a line telescope, across lines they average: the error falls with the 3/2 power.
        window = int(
            np.clip(np.ceil(((np.sqrt(2) * noise / _SLOPE_NOISE) ** (2 / 3) - 1) / 2), 0, _WIDEST_SLOPE_WINDOW)
        )
        before = [(0, 0), (0, 0)]
        before[axis] = (1, 1)
        padded, present = np.pad(step, before), np.pad(on_surface, before).astype(np.float32)
        pair = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        other = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        total, count = padded[pair] + padded[other], present[pair] + present[other]
        if window:
            size = (2 * window + 1, 2 * window + 1)
            total, count = _box_sum(total, size), _box_sum(count, size)
        slopes.append(np.asarray(total / np.maximum(count, 1)))
    return slopes[0], slopes[1]


def _box_sum(values: FloatArray, size: tuple[int, int]) -> FloatArray:
    return np.asarray(cv2.boxFilter(values, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32)


def ray_gradients(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the change of the rays (3, H, W) per (row, column), of the same shape."""
    by_row, by_column = np.empty_like(rays), np.empty_like(rays)
    by_row[:, 1:-1] = (rays[:, 2:] - rays[:, :-2]) * np.float32(0.5)
    by_row[:, 0], by_row[:, -1] = rays[:, 1] - rays[:, 0], rays[:, -1] - rays[:, -2]
    by_column[..., 1:-1] = (rays[..., 2:] - rays[..., :-2]) * np.float32(0.5)
    by_column[..., 0], by_column[..., -1] = rays[..., 1] - rays[..., 0], rays[..., -1] - rays[..., -2]
    return by_row, by_column


def normals_of(
    rays: FloatArray, gradients: tuple[FloatArray, FloatArray], slopes: tuple[FloatArray, FloatArray]
) -> NDArray[np.float32]:
    """Return unit normals toward the scanner, (3, H, W): with p = r d, dp/r = dd + d dr/r along each axis."""
    a, b = (gradient + slope * rays for gradient, slope in zip(gradients, slopes, strict=True))
    normal = np.empty_like(rays)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(a[i], b[j], out=normal[k])
        normal[k] -= a[j] * b[i]
    toward = normal[0] * rays[0] + normal[1] * rays[1] + normal[2] * rays[2]
    normal /= np.copysign(np.maximum(length_of(normal), np.float32(1e-20)), -toward)
    return normal


def length_of(planes: FloatArray) -> FloatArray:
    """Return the lengths (H, W) of vectors stored as planes (3, H, W)."""
    total = np.square(planes[0])
    total += np.square(planes[1])
    total += np.square(planes[2])
    return np.asarray(np.sqrt(total, out=total))
