"""The range of the surface that a ray between the scan's cells meets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.scan import Scan

_EDGE_FRACTION = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRanges:
    """What a scan measures along N rays."""

    ranges: FloatArray
    """(N,) m, of the surface met; NaN without a return or at a depth edge."""
    edge: BoolArray
    """(N,) bool: a depth edge is why there is none."""
    nearest: FloatArray
    """(N,) m, the nearest of the cells around: at a depth edge, the surface that it belongs to; NaN: no return."""


def surface_range(scan: Scan, rays: FloatArray) -> NDArray[np.float64]:
    """Return the range (N,), m, of the surface that rays (N, 3) meet; NaN without a return or at a depth edge.

    Inside a surface, bilinear in 1/range of the four cells around, which is exact on a plane up to their angles.
    """
    return np.asarray(measured_ranges(scan, rays).ranges)


def measured_ranges(scan: Scan, rays: FloatArray) -> MeasuredRanges:
    """Return the range of `surface_range` along unit rays (N, 3), and why where there is none."""
    cells = np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)
    height, width = scan.shape
    row, column = cells[:, 0], cells[:, 1]
    with np.errstate(invalid="ignore"):
        inside = (row >= -0.5) & (row <= height - 0.5) & (column >= -0.5) & (column <= width - 0.5)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    i = np.clip(np.floor(row).astype(np.intp), 0, height - 2)
    j = np.clip(np.floor(column).astype(np.intp), 0, width - 2)
    a, b = np.clip(row - i, 0, 1), np.clip(column - j, 0, 1)
    corners = np.stack([scan.ranges[i + di, j + dj] for di in (0, 1) for dj in (0, 1)]).astype(np.float64)
    with np.errstate(invalid="ignore"):
        low, high = corners.min(axis=0), corners.max(axis=0)
        nearest = np.where(inside, np.fmin.reduce(corners, axis=0), np.nan)
        smooth = inside & (high - low <= _EDGE_FRACTION * low)
        edge = inside & (high - low > _EDGE_FRACTION * low)
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    inverse = (weights / np.where(smooth, corners, 1)).sum(axis=0)
    return MeasuredRanges(np.where(smooth, 1 / inverse, np.nan), edge, nearest)
