"""Ranges of the surface along rays between the scan's cells, and their relative quality.

Three effects make a range noisier than others: a weak return; grazing incidence, at which a ray beside the cell meets
another range; and a depth edge nearby, whose two surfaces the laser spot may have mixed.

Source: thesis 2.1 and 4 for the effects. The variance is proportional to 1 / light: in the simulator, from a tenth to
16 times the usual light, to 15 % of the standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.between_lines import ranges_between_lines

EDGE_FRACTION = 0.04
"""Neighbouring ranges that differ by more than this fraction of the nearer one belong to two surfaces."""
_MIN_NOISE_M = 1e-3  # least noise assumed of a usual return, to which the other effects are compared
_MIN_WEAKNESS, _MAX_WEAKNESS = 0.25, 16.0  # factors of the variance; beyond, detectors saturate or reach their limit
_OFF_RAY_CELLS = 0.3  # rms distance of a picked ray from the centre of its cell
_NEAR_EDGE = 4.0  # times the variance within two cells of a depth edge
_AROUND = 2
_SAMPLE = 10_000  # cells from which the usual light is estimated


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRanges:
    """Ranges of a scan along N rays."""

    ranges: FloatArray
    """(N,) m, of the surface hit; NaN without a return or at a depth edge."""
    edge: BoolArray
    """(N,) bool: no range because of a depth edge."""
    outline: FloatArray
    """(N,) m, as `ranges`, but at a depth edge or the rim of a hole that of the nearer surface, to which an outline
    belongs; NaN: none."""
    cells: IntArray
    """(N, 4) the four surrounding cells, as flat indices into the scan."""
    shares: FloatArray
    """(N, 4) weight of each cell in 1 / `outline`; rows sum to 1, or to 0 without a return."""
    sigma: FloatArray
    """(N,) m: standard deviation of a range between lines of a coarse scan, see `ranges_between_lines`; NaN: the range
    is that of the cells beside the ray."""


def surface_range(scan: Scan, rays: FloatArray) -> NDArray[np.float64]:
    """Return the range (N,), m, of the surface along rays (N, 3); NaN without a return or at a depth edge.

    Inside a surface, bilinear in 1/range of the four surrounding cells, which is exact on a plane up to their angles.
    Where their ranges differ, or some have none, that of the plane through the returns all around the ray, if there is
    one: neighbouring lines of a coarse scan meet the ground metres apart.
    """
    return np.asarray(measured_ranges(scan, rays).ranges)


def measured_ranges(scan: Scan, rays: FloatArray) -> MeasuredRanges:
    """Return the ranges of `surface_range` along unit rays (N, 3), with the reason for missing ones."""
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
    # equal weights for the cells of the nearer surface: taking the smallest range would select by noise
    equal = near / np.maximum(np.count_nonzero(near, axis=1), 1)[:, None]
    shares = np.where(smooth[:, None], bilinear, equal)
    inverse = (shares / np.where(near | smooth[:, None], corners, 1)).sum(axis=1)
    with np.errstate(divide="ignore"):
        outline = np.where(near.any(axis=1), 1 / inverse, np.nan)
    ranges, sigma = np.where(smooth, outline, np.nan), np.full(len(rays), np.nan)
    between = np.flatnonzero(inside & ~smooth)
    if len(between):
        found = ranges_between_lines(scan, rays[between], i[between], j[between])
        known = np.isfinite(found.ranges)
        at = between[known]
        ranges[at] = outline[at] = found.ranges[known]
        sigma[at], shares[at], cells[at], edge[at] = found.sigma[known], found.shares[known], found.cells[known], False
    return MeasuredRanges(ranges, edge, outline, cells, shares, sigma)


def range_noise_m(scan: Scan, rays: FloatArray) -> FloatArray:
    """Return the standard deviation (N,), m, of the range of a cell along each ray (N, 3): a weak return is noisier."""
    row, column = _nearest_cells(scan, rays)
    return np.asarray(usual_noise_m(scan) * np.sqrt(_weakness(scan, row, column)))


def range_quality(scan: Scan, rays: FloatArray, found: MeasuredRanges | None = None) -> FloatArray:
    """Return the relative information (inverse variance) of the ranges along rays.

    Args:
        scan: the scan.
        rays: (N, 3) unit, scanner frame.
        found: the ranges along them, of which those between lines have standard deviations of their own.

    Returns:
        (N,) above 0, at most 4; 1 for a usual return from a surface facing the scanner, far from depth edges. The value
        is meaningless without a return and outside the scan.
    """
    height, width = scan.shape
    row, column = _nearest_cells(scan, rays)
    steps = np.arange(-_AROUND, _AROUND + 1)
    rows = np.clip(row[:, None] + steps, 0, height - 1)[:, :, None]
    columns = np.clip(column[:, None] + steps, 0, width - 1)[:, None, :]
    around = scan.ranges[rows, columns].astype(np.float64)  # (N, 5, 5)
    noise_m = usual_noise_m(scan)
    quality = 1 / (_weakness(scan, row, column) * _edge_factor(around) + _slope_variance(around, noise_m))
    if found is not None:
        between = np.isfinite(found.sigma)
        quality = np.where(between, noise_m**2 / (noise_m**2 + np.where(between, found.sigma, 0) ** 2), quality)
    return np.asarray(quality)


def _nearest_cells(scan: Scan, rays: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the row and the column (N,) of the cell nearest to each ray."""
    cells = np.nan_to_num(np.asarray(scan.geometry.cell_of(rays), dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    row, column = (np.clip(np.rint(cells[:, k]), 0, scan.shape[k] - 1).astype(np.intp) for k in (0, 1))
    return row, column


def _weakness(scan: Scan, row: IntArray, column: IntArray) -> FloatArray:
    """Return the factor of the range variance due to the returned light."""
    stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLE)))
    light = _light(scan, (slice(None, None, stride), slice(None, None, stride)))
    known = light[np.isfinite(light)]
    usual = float(np.median(known)) if len(known) else 0.0
    if usual <= 0:
        return np.ones(len(row))
    here = np.nan_to_num(_light(scan, (row, column)), nan=usual)
    return np.asarray(np.clip(usual / np.maximum(here, usual / _MAX_WEAKNESS), _MIN_WEAKNESS, _MAX_WEAKNESS))


def _light(scan: Scan, cells: tuple[Any, ...]) -> FloatArray:
    """Return the returned light of cells, in any unit; NaN without a return."""
    light, ranges = scan.intensity[cells].astype(np.float64), scan.ranges[cells].astype(np.float64)
    if scan.intensity_is == "range_normalised":
        return np.asarray(light / (ranges * ranges))
    return np.where(np.isfinite(ranges), light, np.nan)


def usual_noise_m(scan: Scan) -> float:
    """Return the range noise of a usual return of a scan, m, from second differences along some rows."""
    rows = max(1, int(scan.shape[0] * scan.shape[1] / _SAMPLE))
    bend = np.abs(np.diff(scan.ranges[::rows].astype(np.float64), n=2, axis=1))
    bend = bend[np.isfinite(bend)]
    return max(_MIN_NOISE_M, float(1.4826 * np.median(bend) / np.sqrt(6))) if len(bend) else _MIN_NOISE_M


def _slope_variance(around: FloatArray, noise_m: float) -> FloatArray:
    """Return the variance added by a ray off the centre of its cell, relative to that of a usual return."""
    variance = np.zeros(len(around))
    middle = _AROUND
    for line in (around[:, middle], around[:, :, middle]):
        steps = np.diff(line[:, middle - 1 : middle + 2], axis=1)
        # the other side may be another surface, and steps of both signs are noise, not slope
        least = np.nan_to_num(np.fmin(*np.abs(steps).T), nan=0.0)
        variance += np.where(steps[:, 0] * steps[:, 1] < 0, 0.0, (_OFF_RAY_CELLS * least / noise_m) ** 2)
    return variance


def _edge_factor(around: FloatArray) -> FloatArray:
    """Return the factor of the variance due to a depth edge, or a cell without return, nearby."""
    jump = np.zeros(len(around), dtype=np.bool_)
    for axis in (1, 2):
        with np.errstate(invalid="ignore"):
            low = np.minimum(np.delete(around, 0, axis=axis), np.delete(around, -1, axis=axis))
            jump |= ~(np.abs(np.diff(around, axis=axis)) <= EDGE_FRACTION * low).all(axis=(1, 2))
    return np.where(jump, _NEAR_EDGE, 1.0)
