"""How far a range may be trusted beside others of the same scan, as a number that a solver can weigh it by.

Three things make a range noisier than others: little light came back, the surface is seen at a grazing angle, so that
a ray beside its cell meets another range, and a depth edge is near, whose two surfaces the spot may have mixed.

Source: thesis 2.1 and 4 for the effects. The variance goes as 1 / light: in the simulator so from a tenth to 16 times
the usual light, to 15 % of the standard deviation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ladarreg_core.arrays import FloatArray, IntArray
from ladarreg_core.scan import Scan

_LEAST_NOISE_M = 1e-3  # of a usual return, against which the other effects are held; scans without noise have it
_LEAST_WEAKNESS, _MOST_WEAKNESS = 0.25, 16.0  # of the variance; beyond, detectors saturate or are at their limit
_OFF_RAY_CELLS = 0.3  # rms distance of a picked ray from the middle of its cell
_NEAR_EDGE = 4.0  # times the variance within two cells of a depth edge
_EDGE_FRACTION = 0.04
_AROUND = 2
_SAMPLE = 10_000  # cells that tell the usual light


def range_quality(scan: Scan, rays: FloatArray) -> FloatArray:
    """Return the relative information of the ranges along some rays.

    Args:
        scan: the scan.
        rays: (N, 3) unit, scanner frame.

    Returns:
        (N,) above 0, at most 4; 1 for a usual return from a surface that faces the scanner, far from depth edges.
        Where there is no return, or outside the scan, the value means nothing.
    """
    height, width = scan.shape
    cells = np.nan_to_num(np.asarray(scan.geometry.cell_of(rays), dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    row = np.clip(np.rint(cells[:, 0]), 0, height - 1).astype(np.intp)
    column = np.clip(np.rint(cells[:, 1]), 0, width - 1).astype(np.intp)
    steps = np.arange(-_AROUND, _AROUND + 1)
    rows = np.clip(row[:, None] + steps, 0, height - 1)[:, :, None]
    columns = np.clip(column[:, None] + steps, 0, width - 1)[:, None, :]
    around = scan.ranges[rows, columns].astype(np.float64)  # (N, 5, 5)
    return np.asarray(
        1 / (_weakness(scan, row, column) * _edge_factor(around) + _slope_variance(around, _noise_m(scan)))
    )


def _weakness(scan: Scan, row: IntArray, column: IntArray) -> FloatArray:
    """Return the factor of the range's variance by the light that came back."""
    stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLE)))
    light = _light(scan, (slice(None, None, stride), slice(None, None, stride)))
    known = light[np.isfinite(light)]
    usual = float(np.median(known)) if len(known) else 0.0
    if usual <= 0:
        return np.ones(len(row))
    here = np.nan_to_num(_light(scan, (row, column)), nan=usual)
    return np.asarray(np.clip(usual / np.maximum(here, usual / _MOST_WEAKNESS), _LEAST_WEAKNESS, _MOST_WEAKNESS))


def _light(scan: Scan, cells: tuple[Any, ...]) -> FloatArray:
    """Return the light that came back from some cells, in any unit; NaN without a return."""
    light, ranges = scan.intensity[cells].astype(np.float64), scan.ranges[cells].astype(np.float64)
    if scan.intensity_is == "range_normalised":
        return np.asarray(light / (ranges * ranges))
    return np.where(np.isfinite(ranges), light, np.nan)


def _noise_m(scan: Scan) -> float:
    """Return the range noise of a usual return, by the second differences along some rows, m."""
    rows = max(1, int(scan.shape[0] * scan.shape[1] / _SAMPLE))
    bend = np.abs(np.diff(scan.ranges[::rows].astype(np.float64), n=2, axis=1))
    bend = bend[np.isfinite(bend)]
    return max(_LEAST_NOISE_M, float(1.4826 * np.median(bend) / np.sqrt(6))) if len(bend) else _LEAST_NOISE_M


def _slope_variance(around: FloatArray, noise_m: float) -> FloatArray:
    """Return the variance that a ray off the middle of its cell adds, over that of a usual return."""
    variance = np.zeros(len(around))
    middle = _AROUND
    for line in (around[:, middle], around[:, :, middle]):
        steps = np.diff(line[:, middle - 1 : middle + 2], axis=1)
        # the other side may be another surface, and steps of both signs are no slope but noise
        least = np.nan_to_num(np.fmin(*np.abs(steps).T), nan=0.0)
        variance += np.where(steps[:, 0] * steps[:, 1] < 0, 0.0, (_OFF_RAY_CELLS * least / noise_m) ** 2)
    return variance


def _edge_factor(around: FloatArray) -> FloatArray:
    """Return the factor of the variance by a depth edge nearby, or by cells without a return: edges of another kind."""
    jump = np.zeros(len(around), dtype=np.bool_)
    for axis in (1, 2):
        with np.errstate(invalid="ignore"):
            low = np.minimum(np.delete(around, 0, axis=axis), np.delete(around, -1, axis=axis))
            jump |= ~(np.abs(np.diff(around, axis=axis)) <= _EDGE_FRACTION * low).all(axis=(1, 2))
    return np.where(jump, _NEAR_EDGE, 1.0)
