"""Order of a file's rows and columns: checks that they form a scan grid, and puts row 0 on top and column 0 left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scanner.gridding import rotation_from_pole

_JUMP_STEPS = 4.0
_MAX_JUMPS = 0.005
_MAX_FOLDED = 0.02
_STEEPEST_SHEAR = 0.85
_CLEAR_TRAVEL = 0.2
_MIN_PAIRS = 12
_FLIPPED_ROWS = 64
_MAX_CELLS = 250_000  # larger grids are judged by every n-th row and column


@dataclass(frozen=True, slots=True)
class GridOrder:
    """Reordering of a grid: transposition first, then flips."""

    transpose: bool
    flip_rows: bool
    flip_columns: bool

    def apply(self, grid: NDArray[Any]) -> NDArray[Any]:
        """Return a grid (H, W, ...) in the right order."""
        if self.transpose:
            grid = np.swapaxes(grid, 0, 1)
        return np.ascontiguousarray(grid[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1])

    def apply_in_place(self, grid: NDArray[Any]) -> NDArray[Any]:
        """Return a grid (H, W, ...) in the right order; its memory is used again, except by a transposition."""
        if self.transpose:
            grid = np.ascontiguousarray(np.swapaxes(grid, 0, 1))
        height = len(grid)
        if self.flip_rows:
            for first in range(0, height // 2, _FLIPPED_ROWS):
                last = min(first + _FLIPPED_ROWS, height // 2)
                top = grid[first:last].copy()
                grid[first:last] = grid[height - last : height - first][::-1]
                grid[height - last : height - first] = top[::-1]
        if self.flip_columns:
            for first in range(0, height, _FLIPPED_ROWS):
                grid[first : first + _FLIPPED_ROWS] = grid[first : first + _FLIPPED_ROWS, ::-1].copy()
        return grid

    def __bool__(self) -> bool:
        return self.transpose or self.flip_rows or self.flip_columns


def unit_rays(points: FloatArray) -> NDArray[np.float64]:
    """Return (H, W, 3) unit rays of a grid of points; NaN where there is no return."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        p = np.asarray(points, dtype=np.float64)
        length = np.linalg.norm(p, axis=-1, keepdims=True)
        return np.where(np.isfinite(length) & (length > 0), p / length, np.nan)


def is_scan_grid(rays: FloatArray) -> bool:
    """Return whether neighbours in rows and columns of rays (H, W, 3) are neighbours in space.

    Headers are not reliable: points may be stored in another order than width and height suggest, or each row may start
    at another azimuth. In a grid, neighbouring rays advance by equal steps, rows and columns do not cross at an acute
    angle, and cells are not folded over.
    """
    if min(rays.shape[:2]) < 2:
        return False
    right, down = np.diff(rays, axis=1), np.diff(rays, axis=0)
    for step in (right, down):
        size = np.linalg.norm(step, axis=-1)
        size = size[np.isfinite(size)]
        if len(size) < _MIN_PAIRS or not np.median(size) > 0:
            return False
        if np.mean(size > _JUMP_STEPS * np.median(size)) > _MAX_JUMPS:
            return False
    right, down, centre = right[:-1], down[:, :-1], rays[:-1, :-1]
    lengths = np.linalg.norm(right, axis=-1) * np.linalg.norm(down, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        shear = np.abs((right * down).sum(-1)) / lengths
        side = np.sign((np.cross(right, down) * centre).sum(-1))
    side, shear = side[np.isfinite(shear)], shear[np.isfinite(shear)]
    if len(side) < _MIN_PAIRS or np.median(shear) > _STEEPEST_SHEAR:
        return False
    return bool(min(np.mean(side > 0), np.mean(side < 0)) < _MAX_FOLDED)


def order_of(rays: FloatArray) -> GridOrder:
    """Return the reordering that a grid of rays (H, W, 3), NaN or zero where unknown, needs.

    Afterwards latitude decreases along the rows and columns run to the right as seen from the scanner. In a depth
    camera's optical frame (Z forward, Y down) up is -Y. If latitude varies along neither axis, rows keep their order.
    """
    stride = max(1, int(np.sqrt(rays.shape[0] * rays.shape[1] / _MAX_CELLS)))
    rays = rays[::stride, ::stride]
    rays = np.where((rays != 0).any(axis=-1, keepdims=True), rays, np.float32(np.nan))
    pole = rotation_from_pole(rays[np.isfinite(rays[..., 0])])
    rays = rays if pole is None else rays @ pole.T
    latitude = np.arcsin(np.clip(rays[..., 2], -1, 1))
    by_row, by_column = _travel(latitude, 0), _travel(latitude, 1)
    extent = float(np.nanmax(latitude) - np.nanmin(latitude))
    transpose = abs(by_column) > 2 * abs(by_row) and abs(by_column) > _CLEAR_TRAVEL * extent
    along = by_column if transpose else by_row
    flip_rows = along > 0 and abs(along) > _CLEAR_TRAVEL * extent
    turned = np.swapaxes(rays, 0, 1) if transpose else rays
    turned = turned[::-1] if flip_rows else turned
    right, down = np.diff(turned, axis=1)[:-1], np.diff(turned, axis=0)[:, :-1]
    side = (np.cross(right, down) * turned[:-1, :-1]).sum(-1)
    side = side[np.isfinite(side)]
    # Seen from the scanner, right x down points away from it; otherwise the grid is mirrored.
    return GridOrder(bool(transpose), bool(flip_rows), bool(np.sum(np.sign(side)) < 0))


def _travel(latitude: NDArray[np.float64], axis: int) -> float:
    """Return the change of latitude from the first to the last row (or column), from its median step."""
    steps = np.diff(latitude, axis=axis)
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) * latitude.shape[axis] if len(steps) else 0.0
