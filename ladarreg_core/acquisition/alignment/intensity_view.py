"""Scans prepared for the comparison of their intensities, looked up at points that other scans see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.voxel_planes import dots
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.scan import Scan

_BAND = 5.0  # what varies over more than so many standard deviations of the smoothing is removed
_BORDER = 2.0
"""How far smoothing reaches, in standard deviations."""
_ONE_SIDED = 0.055
"""Centre of what is smoothed, in standard deviations of the smoothing: as near a straight border, `_BORDER` from it."""
_STEEPEST = 6.0  # relative change of the range over a cell, in steps: beyond it, a depth edge
_MAX_PARALLAX_BLURS = 0.5
_FARTHEST = 1e6  # m
_EDGE_CELLS = 5
_EDGE_WINDOWS = (3, 7)  # an edge may be hidden in a gap of a few cells without returns
_SAME_SURFACE = (0.03, 0.02)  # m, and on top of it a share of the range
_FLOOR_SHARE = 0.25  # of the median intensity


@dataclass(frozen=True, slots=True, eq=False)
class IntensityView:
    """One scan, prepared for the comparison of its intensities."""

    scan: Scan
    light: NDArray[np.float16]
    """(H, W) smoothed logarithm of the intensity; NaN as near edges and the borders of holes as smoothing reaches.
    In half precision, a thousandth of the values: many scans are held at several levels."""
    by_cell: tuple[NDArray[np.float16], NDArray[np.float16]]
    """Its derivatives by row and by column."""
    gap: NDArray[np.float16]
    """(H, W) largest step of the inverse range (1/m) at a depth edge as near as smoothing reaches. What lies beyond the
    edge is in the smoothing, too, and for a scanner elsewhere it lies elsewhere: by this times the distance."""
    blur_cells: float
    """Standard deviation of the smoothing."""

    def most_gap(self, apart_m: float) -> float:
        """Return the largest `gap` at which this may be compared with a scan from a centre so far away."""
        step = float(np.mean(self.scan.geometry.step_rad))
        return _MAX_PARALLAX_BLURS * self.blur_cells * step / max(apart_m, 1e-6)

    @staticmethod
    def of(scan: Scan, floor: float, blur_cells: float) -> IntensityView:
        """Return a scan prepared for comparison.

        Args:
            scan: the scan.
            floor: intensity that is added before the logarithm is taken, the same for all scans.
            blur_cells: standard deviation of the smoothing.
        """
        there = scan.valid
        size = (0, 0)
        light = np.where(there, np.log(np.maximum(scan.intensity, 0) + floor), 0).astype(np.float32)
        # Gloss moves with the scanner's centre, and is smooth: only what is finer is compared.
        blurs = blur_cells, _BAND * blur_cells
        shares = [np.asarray(cv2.GaussianBlur(there.astype(np.float32), size, cells), np.float32) for cells in blurs]
        smooth, wide = (
            cv2.GaussianBlur(light, size, cells) / np.maximum(share, 1e-6)
            for cells, share in zip(blurs, shares, strict=True)
        )
        smooth -= wide
        # Where returns are missing on one side, smoothing is one-sided, and on the other side in another scan.
        gap = _gaps(scan)
        smooth[_widened(gap, _EDGE_CELLS // 2) > 0] = np.nan
        smooth[_one_sided(shares[1], _BAND * blur_cells) | ~there] = np.nan
        gap = _widened(gap, int(np.ceil(_BORDER * _BAND * blur_cells)))
        # At the border the smoothing is one-sided, and on the other side in the scan beside it.
        margin = int(np.ceil(_BORDER * _BAND * blur_cells))
        for border in (smooth[:margin], smooth[-margin:], smooth[:, :margin], smooth[:, -margin:]):
            border[...] = np.nan
        slopes = _slope(smooth, 0), _slope(smooth, 1)
        return IntensityView(scan, smooth.astype(np.float16), slopes, gap.astype(np.float16), blur_cells)


def common_floor(scans: Sequence[Scan]) -> float:
    """Return what is added to the intensities of all scans before their logarithm is taken."""
    middle = [float(np.median(scan.intensity[scan.valid])) for scan in scans]
    return max(_FLOOR_SHARE * float(np.median(middle)), 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a view sees at some points."""

    light: FloatArray
    slopes: FloatArray
    """(N, 2)"""
    ranges: FloatArray
    gap: FloatArray
    cells: FloatArray
    """(N, 2) where that is."""

    def good(self, distances: FloatArray, most_gap: float) -> BoolArray:
        """Return which points, (N,) m from this view, lie on the surface that it sees, with no larger gap."""
        apart = np.abs(distances - self.ranges)
        with np.errstate(invalid="ignore"):
            same = (apart < _SAME_SURFACE[0] + _SAME_SURFACE[1] * self.ranges) & (self.gap <= most_gap)
        return np.asarray(same & np.isfinite(self.light) & np.isfinite(self.slopes).all(axis=-1))


def lookup(view: IntensityView, points: FloatArray) -> Seen:
    """Return what a view sees at points (N, 3) in its frame; NaN beyond its border."""
    return lookup_at(view, np.asarray(view.scan.geometry.cell_of(points), np.float64))


def lookup_at(view: IntensityView, cells: FloatArray) -> Seen:
    """Return what a view sees at fractional cells (N, 2); NaN beyond its border."""
    height, width = view.scan.shape
    cell = cells
    with np.errstate(invalid="ignore"):
        inside = (cell >= 0).all(axis=-1) & (cell[:, 0] <= height - 1) & (cell[:, 1] <= width - 1)
    cell = np.where(inside[:, None], cell, 0)
    top = np.minimum(cell[:, 0].astype(int), height - 2)
    left = np.minimum(cell[:, 1].astype(int), width - 2)
    down, right = cell[:, 0] - top, cell[:, 1] - left
    flat = top * width + left

    def between(field: FloatArray) -> FloatArray:
        values = field.ravel()
        upper = (1 - right) * values[flat] + right * values[flat + 1]
        lower = (1 - right) * values[flat + width] + right * values[flat + width + 1]
        return np.asarray(np.where(inside, (1 - down) * upper + down * lower, np.nan))

    slopes = np.stack([between(view.by_cell[0]), between(view.by_cell[1])], axis=-1)
    nearest = np.rint(cell[:, 0]).astype(int), np.rint(cell[:, 1]).astype(int)
    ranges = np.where(inside, view.scan.ranges[nearest], np.nan)
    return Seen(between(view.light), slopes, ranges, view.gap[nearest], cells)


def by_point(scan: Scan, local: FloatArray, slopes: FloatArray, cells: FloatArray) -> NDArray[np.float64]:
    """Return derivatives by the point (N, 3), in the scan's frame, of what has slopes (N, 2) by row and column.

    Args:
        scan: the scan.
        local: (N, 3) m, the points.
        slopes: (N, 2).
        cells: (N, 2) where the scan sees the points.
    """
    geometry = scan.geometry
    half = np.full(2, 0.5)
    # How rays turn from cell to cell, which is inverted: finding the cells of points beside would take much longer.
    turns = np.stack(
        [np.subtract(geometry.ray_at(cells + half * side), geometry.ray_at(cells - half * side)) for side in np.eye(2)],
        axis=1,
    )  # (N, 2, 3)
    rr, rc, cc = (dots(turns[:, i], turns[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        det = rr * cc - rc**2
        by_row = (cc * slopes[:, 0] - rc * slopes[:, 1]) / det
        by_column = (rr * slopes[:, 1] - rc * slopes[:, 0]) / det
        by_ray = by_row[:, None] * turns[:, 0] + by_column[:, None] * turns[:, 1]
        squared = dots(local, local)[:, None]
        return np.asarray((by_ray - dots(by_ray, local)[:, None] * local / squared) / np.sqrt(squared))


def lengths(vectors: FloatArray) -> NDArray[np.float64]:
    """Return the lengths (N,) of vectors (N, 3)."""
    return np.sqrt(dots(vectors, vectors))


def _slope(field: FloatArray, axis: int) -> NDArray[np.float16]:
    out = np.full(field.shape, np.nan, np.float16)
    if axis == 0:
        out[1:-1] = (field[2:] - field[:-2]) / 2
    else:
        out[:, 1:-1] = (field[:, 2:] - field[:, :-2]) / 2
    return out


def _gaps(scan: Scan) -> NDArray[np.float32]:
    """Return (H, W) the step of the inverse range (1/m) at depth edges and grazing surfaces, and zero elsewhere."""
    ranges = np.asarray(scan.ranges, np.float32)
    step = 2 * float(np.hypot(*scan.geometry.step_rad))
    gap = np.zeros(scan.shape, np.float32)
    for window in _EDGE_WINDOWS:
        square = np.ones((window, window), np.uint8)
        far = cv2.dilate(np.where(scan.valid, ranges, 0), square)
        near = np.minimum(cv2.erode(np.where(scan.valid, ranges, _FARTHEST).astype(np.float32), square), _FARTHEST)
        edge = far > near * (1 + _STEEPEST * step * (window - 1) / 2) + 0.02
        gap[edge] = np.maximum(gap[edge], 1 / near[edge] - 1 / far[edge])
    return gap


def _widened(field: NDArray[np.float32], cells: int) -> NDArray[np.float32]:
    """Return the largest value within so many cells, up or down and to the sides."""
    return np.asarray(cv2.dilate(field, np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)), np.float32)


def _one_sided(share: FloatArray, cells: float) -> BoolArray:
    """Return the cells (H, W) where smoothing has more to smooth on one side, by the share of cells with returns."""
    slope = np.hypot(cv2.Sobel(share, cv2.CV_32F, 1, 0, ksize=1), cv2.Sobel(share, cv2.CV_32F, 0, 1, ksize=1)) / 2
    return np.asarray(cells * slope > _ONE_SIDED * np.maximum(share, 1e-6))
