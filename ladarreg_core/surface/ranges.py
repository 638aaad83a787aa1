"""The range of the surface that a ray between the scan's cells meets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.scan import Scan

EDGE_FRACTION = 0.04
"""Neighbouring ranges further apart than this, of the nearer one, are two surfaces."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRanges:
    """What a scan measures along N rays."""

    ranges: FloatArray
    """(N,) m, of the surface met; NaN without a return or at a depth edge."""
    edge: BoolArray
    """(N,) bool: a depth edge is why there is none."""
    outline: FloatArray
    """(N,) m, as `ranges`, but of the nearer surface at a depth edge or a hole's rim: an outline is its; NaN: none."""
    cells: IntArray
    """(N, 4) the four cells around, as flat indices into the scan."""
    shares: FloatArray
    """(N, 4) what each cell contributes to 1 / `outline`; rows sum to 1, or to 0 without a return."""


def surface_range(scan: Scan, rays: FloatArray) -> NDArray[np.float64]:
    """Return the range (N,), m, of the surface that rays (N, 3) meet; NaN without a return or at a depth edge.

    Inside a surface, bilinear in 1/range of the four cells around, which is exact on a plane up to their angles.
    """
    return np.asarray(measured_ranges(scan, rays).ranges)


def measured_ranges(scan: Scan, rays: FloatArray) -> MeasuredRanges:
    """Return the range of `surface_range` along unit rays (N, 3), and why where there is none."""
    position = np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)
    height, width = scan.shape
    row, column = position[:, 0], position[:, 1]
    with np.errstate(invalid="ignore"):
        inside = (row >= -0.5) & (row <= height - 0.5) & (column >= -0.5) & (column <= width - 0.5)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    i = np.clip(np.floor(row).astype(np.intp), 0, height - 2)
    j = np.clip(np.floor(column).astype(np.intp), 0, width - 2)
    a, b = np.clip(row - i, 0, 1), np.clip(column - j, 0, 1)
    cells = np.stack([(i + di) * width + j + dj for di in (0, 1) for dj in (0, 1)], axis=1)
    corners = scan.ranges.reshape(-1)[cells].astype(np.float64)  # (N, 4)
    with np.errstate(invalid="ignore"):
        low, high = corners.min(axis=1), corners.max(axis=1)
        nearest = np.fmin.reduce(corners, axis=1)
        smooth = inside & (high - low <= EDGE_FRACTION * low)
        edge = inside & (high - low > EDGE_FRACTION * low)
        near = inside[:, None] & (corners - nearest[:, None] <= EDGE_FRACTION * nearest[:, None])
    bilinear = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=1)
    # of the nearer surface's cells each counts alike: the least of them would be the noise's choice
    alike = near / np.maximum(np.count_nonzero(near, axis=1), 1)[:, None]
    shares = np.where(smooth[:, None], bilinear, alike)
    inverse = (shares / np.where(near | smooth[:, None], corners, 1)).sum(axis=1)
    with np.errstate(divide="ignore"):
        outline = np.where(near.any(axis=1), 1 / inverse, np.nan)
    return MeasuredRanges(np.where(smooth, outline, np.nan), edge, outline, cells, shares)
