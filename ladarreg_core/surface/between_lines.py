"""Ranges between the lines of a coarse scan, and between the returns of an accumulated one.

Neighbouring lines of a multi-line lidar meet the ground metres apart, and a grid that was made of an accumulated cloud
has cells without a return everywhere. What lies between is known all the same if the returns on all sides of a ray lie
on one plane, and the returns around them as well. Along a ray's own axis 1 / z of a plane is linear in x / z, y / z.

A hole is not bridged: where nearly all cells around have returns, an empty one was looked at and returned nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.scan import Scan

_ROWS, _COLUMNS = (-1, 0, 1, 2), (-3, -2, -1, 0, 1, 2, 3, 4)
_MIDDLE = (2, 4)  # first row and column of the window that lie beyond the ray
_WIDE = (8, 10)  # rows and columns on each side ...
_FULL = 0.85  # ... of which so many have returns where an empty cell is a hole
_MIN_SUPPORT, _MIN_SHARE = 6, 0.6  # returns of the window on the plane
_OFF_PLANE = 0.015  # of the range
_AROUND = 0.2  # of the four returns' weight: an opposite corner may be missing
_CHUNK = 5_000


@dataclass(frozen=True, slots=True, eq=False)
class BetweenLines:
    """Ranges along N rays."""

    ranges: NDArray[np.float64]
    """(N,) m; NaN where the returns around a ray do not lie on one plane."""
    sigma: NDArray[np.float64]
    """(N,) m, of the range, from the scatter of the returns about the plane; NaN as `ranges`."""
    cells: IntArray
    """(N, 4) the nearest cells with a return on each side, as flat indices into the scan."""
    shares: NDArray[np.float64]
    """(N, 4) weight of each of them at the ray; rows sum to 1."""


def ranges_between_lines(scan: Scan, rays: FloatArray, rows: IntArray, columns: IntArray) -> BetweenLines:
    """Return the ranges of the planes that the returns around rays lie on.

    Args:
        scan: the scan.
        rays: (N, 3) unit, inside the grid.
        rows: (N,) row of the cells before each ray.
        columns: (N,) their columns.
    """
    parts = [
        _ranges(scan, np.asarray(rays[k : k + _CHUNK], np.float64), rows[k : k + _CHUNK], columns[k : k + _CHUNK])
        for k in range(0, len(rays), _CHUNK)
    ]
    return BetweenLines(*(np.concatenate([getattr(p, name) for p in parts]) for name in BetweenLines.__slots__))


def _ranges(scan: Scan, rays: NDArray[np.float64], rows: IntArray, columns: IntArray) -> BetweenLines:
    height, width = scan.shape
    count = len(rays)
    row = rows[:, None, None] + np.array(_ROWS)[:, None]
    column = columns[:, None, None] + np.array(_COLUMNS)
    there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    cell = np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)
    ranges = np.where(there, scan.ranges.reshape(-1)[cell].astype(np.float64), np.nan).reshape(count, -1)
    cell = cell.reshape(count, -1)
    known = np.isfinite(ranges)
    x, y, inverse = _in_own_frame(scan, rays, cell, ranges, known)
    nearest, every_side = _sides(x, y, known)
    shares = _shares(*(np.take_along_axis(axis, nearest, axis=1) for axis in (x, y)))
    full = _fill(scan, rows, columns) > _FULL
    corners = known.reshape(count, len(_ROWS), len(_COLUMNS))[
        :, _MIDDLE[0] - 1 : _MIDDLE[0] + 1, _MIDDLE[1] - 1 : _MIDDLE[1] + 1
    ]
    hole = full & ~corners.all(axis=(1, 2))
    found, sigma = np.full(count, np.nan), np.full(count, np.nan)
    kept = np.flatnonzero(every_side & ~hole)
    found[kept], sigma[kept] = _on_planes(x[kept], y[kept], inverse[kept], known[kept], nearest[kept])
    return BetweenLines(found, sigma, np.take_along_axis(cell, nearest, axis=1), shares)


def _on_planes(
    x: NDArray[np.float64], y: NDArray[np.float64], inverse: NDArray[np.float64], known: NDArray[np.bool_],
    nearest: IntArray,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Return ranges and their standard deviations (N,) of the planes of the returns (N, K); NaN without a plane."""
    # the plane of the four, the support that it has around, and then the plane of the support
    weight = np.zeros_like(x)
    np.put_along_axis(weight, nearest, 1.0, axis=1)
    plane = _plane(x, y, inverse, weight * known)
    for _ in range(2):
        off = np.abs(_at(plane, x, y) - inverse) / np.maximum(inverse, 1e-12)
        on_plane = known & (off <= _OFF_PLANE)
        plane = _plane(x, y, inverse, on_plane.astype(np.float64))
    support = on_plane.sum(axis=1)
    good = (
        np.take_along_axis(on_plane, nearest, axis=1).all(axis=1) & (plane[:, 0] > 0)
        & (support >= _MIN_SUPPORT) & (support >= _MIN_SHARE * known.sum(axis=1))
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(good, 1 / plane[:, 0], np.nan)
        residual = np.where(on_plane, _at(plane, x, y) - inverse, 0)
        scatter = np.sqrt((residual**2).sum(axis=1) / np.maximum(support - 3, 1))
        leverage = _leverage(x, y, on_plane)
        # off the plane by as much as its neighbours are: a surface between lines is not seen
        sigma = np.where(good, scatter * np.sqrt(1 + leverage) * found**2, np.nan)
    return found, sigma


def _fill(scan: Scan, rows: IntArray, columns: IntArray) -> NDArray[np.float64]:
    """Return the share (N,) of the cells around that have a return."""
    height, width = scan.shape
    cells, of_ray = np.unique(rows * width + columns, return_inverse=True)  # many rays of a picture share a cell
    rows, columns = np.divmod(cells, width)
    row = np.clip(rows[:, None, None] + np.arange(1 - _WIDE[0], _WIDE[0] + 1)[:, None], 0, height - 1)
    column = np.clip(columns[:, None, None] + np.arange(1 - _WIDE[1], _WIDE[1] + 1), 0, width - 1)
    return np.asarray(np.isfinite(scan.ranges[row, column]).mean(axis=(1, 2))[of_ray])


def _in_own_frame(
    scan: Scan, rays: NDArray[np.float64], cell: IntArray, ranges: FloatArray, known: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return x / z, y / z and 1 / z (N, K) of returns, z along each ray; 0 where there is none."""
    # the windows of neighbouring rays overlap: each cell's direction is looked up once
    cells, of_window = np.unique(cell, return_inverse=True)
    directions = np.asarray(scan.geometry.ray_at(np.stack(np.divmod(cells, scan.shape[1]), axis=-1).astype(np.float64)))
    beside = np.cross(rays, np.where(np.abs(rays[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    axes = np.stack([rays, beside, np.cross(rays, beside)], axis=-1)
    along = directions[of_window.reshape(cell.shape)] @ axes
    ahead, right, down = along[..., 0], along[..., 1], along[..., 2]
    safe = known & (ahead > 0.1)
    known &= safe
    ahead = np.where(safe, ahead, 1.0)
    return (
        np.where(safe, right / ahead, 0.0),
        np.where(safe, down / ahead, 0.0),
        np.where(safe, 1 / (np.where(safe, ranges, 1.0) * ahead), 0.0),
    )


def _sides(
    x: NDArray[np.float64], y: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest return in each quarter (N, 4), and whether they lie on all sides of the ray."""
    distance = np.where(known, x * x + y * y, np.inf)
    quarters = np.stack(
        [known & ((x < 0) == left) & ((y < 0) == above) for left in (True, False) for above in (True, False)]
    )
    far = np.where(quarters, distance, np.inf)
    nearest = far.argmin(axis=2).T
    present = np.isfinite(far.min(axis=2)).T
    # a quarter without a return takes that of the nearest one: three may still surround the ray
    best = distance.argmin(axis=1)
    nearest = np.where(present, nearest, best[:, None])
    index = np.arange(len(x))[:, None]
    px, py = x[index, nearest], y[index, nearest]
    angle = np.sort(np.arctan2(py, px), axis=1)
    gap = np.diff(np.concatenate([angle, angle[:, :1] + 2 * np.pi], axis=1), axis=1).max(axis=1)
    return nearest, (present.sum(axis=1) >= 3) & (gap <= (1 + _AROUND) * np.pi)


def _plane(
    x: NDArray[np.float64], y: NDArray[np.float64], inverse: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the coefficients (N, 3) of 1, x and y that fit 1 / z best."""
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    weighted = (design * weight[..., None]).swapaxes(1, 2)
    right = weighted @ inverse[..., None]
    return np.asarray((np.linalg.pinv(weighted @ design, hermitian=True) @ right)[..., 0])


def _at(plane: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(plane[:, :1] + plane[:, 1:2] * x + plane[:, 2:3] * y)


def _leverage(x: NDArray[np.float64], y: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the variance (N,) of the plane at the ray, over that of a single return."""
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    normal = (design * used[..., None]).swapaxes(1, 2) @ design
    return np.asarray(np.linalg.pinv(normal, hermitian=True)[:, 0, 0])


def _shares(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (N, 4) of four returns by their distances from the ray; rows sum to 1."""
    near = 1 / np.maximum(np.hypot(x, y), 1e-6)
    return np.asarray(near / near.sum(axis=1, keepdims=True))
