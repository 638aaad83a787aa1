"""Spacing of the points of a cloud without a grid: the steps of latitude and longitude that it supports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray

LARGE_CLOUD = 1_000_000
"""Points; of larger clouds, a part shows the structure."""
_MIN_POINTS = 12
_SEED = 20
_NEIGHBOURS = 160
_WIDE_NEIGHBOURS = 64  # the 16 next points may lie on one line of a pattern that nearly repeats
_SAMPLES = 3000
_WINDOWS = 60
_WINDOW_POINTS = 6_000
_STRIP = 0.3
_REGULAR = 0.5
_MIN_STREWN = 5_000
_CLUSTERED = 0.45  # a tenth of unordered points have another one this close, in typical distances; of a raster, none
# One cell in five is empty by chance, and filled; 3 lose detail, 1 smears it: both register worse.
_POINTS_PER_CELL = 1.5
_SPARSE = 80


def steps_of(longitude: FloatArray, latitude: FloatArray) -> tuple[float, float, bool]:
    """Return (latitude step, longitude step), rad, from the spacing of the points, and whether these are unordered.

    The density gives the product of the steps; a regular distance to the next point directly above, or beside, gives
    one of them; otherwise the steps are taken as equal. Strewn points come in clusters and gaps: cells that hold
    several of them even where they are sparse are the finest that they support.
    """
    from scipy.spatial import cKDTree

    plane, sample = _windows(_distinct(np.stack([longitude, latitude], axis=-1)))
    count = len(plane)
    if count < _MIN_POINTS:  # too few for spacings: use the spread
        spans = [max(float(np.ptp(angle)), 1e-9) for angle in (longitude, latitude)]
        return float(np.sqrt(spans[0] * spans[1] / count)), float(np.sqrt(spans[0] * spans[1] / count)), False
    neighbours = min(_NEIGHBOURS, count - 1)
    distance, index = cKDTree(plane).query(sample, k=neighbours + 1)
    few = min(16, neighbours)
    area = np.pi * distance[:, few] ** 2 / few
    typical = float(np.sqrt(np.median(area)))
    if not typical > 0:  # most points very nearly coincide
        spans = [max(float(np.ptp(angle)), 1e-9) for angle in (longitude, latitude)]
        typical = float(np.sqrt(spans[0] * spans[1] / count))
    offsets = plane[index] - sample[:, None, :]
    up, up_regular = _next_along(offsets[..., 1], offsets[..., 0], typical)
    side, side_regular = _next_along(offsets[..., 0], offsets[..., 1], typical)
    if max(up_regular, side_regular) < _REGULAR:
        own = np.sqrt(area)
        if len(longitude) >= _MIN_STREWN and np.percentile(distance[:, 1] / own.clip(1e-12), 10) < _CLUSTERED:
            wide = min(_WIDE_NEIGHBOURS, neighbours)
            around = np.maximum(area, np.pi * distance[:, wide] ** 2 / wide)
            step = float(np.sqrt(_POINTS_PER_CELL * np.percentile(around, _SPARSE)))
            return step, step, True
        return typical, typical, False
    if min(up_regular, side_regular) >= _REGULAR and 0.5 < up * side / typical**2 < 2:
        return up, side, False
    return (up, typical**2 / up, False) if up_regular >= side_regular else (typical**2 / side, side, False)


def _windows(plane: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (N, 2) and a sample of them (K, 2) whose neighbours are among them.

    Of a large cloud, these are the points of some windows of the view: a tree of all points would take half a minute.
    """
    generator = np.random.default_rng(_SEED)
    count = len(plane)
    if count <= LARGE_CLOUD:
        return plane, plane if count <= _SAMPLES else plane[generator.choice(count, _SAMPLES, replace=False)]
    low, span = plane.min(axis=0), np.ptp(plane, axis=0)
    side = np.sqrt(span[0] * span[1] * _WINDOW_POINTS / count)
    place = (plane - low) / side
    across = int(place[:, 0].max()) + 1
    window = place[:, 1].astype(np.intp) * across + place[:, 0].astype(np.intp)
    chosen = np.unique(window[generator.choice(count, _WINDOWS)])
    inside = np.isin(window, chosen)
    place, plane = place[inside] % 1, plane[inside]
    inner = np.flatnonzero((np.abs(place - 0.5) < 0.2).all(axis=1))
    if not len(inner):
        inner = np.arange(len(plane))
    return plane, plane[generator.choice(inner, min(_SAMPLES, len(inner)), replace=False)]


def _distinct(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distinct rows, in their order: a tree is of no use with many coincident points."""
    first = np.unique(plane.view(np.complex128)[:, 0], return_index=True)[1]
    return plane if len(first) == len(plane) else plane[np.sort(first)]


def _next_along(along: FloatArray, across: FloatArray, typical: float) -> tuple[float, float]:
    """Return the median distance to the next point along an axis, and the share of points within 10 % of it."""
    beside = (np.abs(across) < _STRIP * typical) & (along > 1e-3 * typical)
    nearest = np.where(beside, along, np.inf).min(axis=1)
    found = nearest[np.isfinite(nearest)]
    if len(found) < 0.5 * len(nearest):
        return typical, 0.0
    middle = float(np.median(found))
    return middle, float(np.mean(np.abs(nearest - middle) < 0.1 * middle))
