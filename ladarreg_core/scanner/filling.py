"""Fills cells without a return from the surface around them; holes stay holes."""

from __future__ import annotations

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray, IntArray

_MIN_AROUND = 5
_GAP_CELLS = 6
_FILL_PASSES = 2
_SAME_M = 0.1
_SAME = 0.03


def range_tolerance(ranges: FloatArray) -> FloatArray:
    """Return the differences (N,), m, up to which two ranges near `ranges` (N,) are of the same surface."""
    return np.asarray(np.maximum(_SAME_M, _SAME * ranges))


def fill_silence(grids: list[FloatArray]) -> int:
    """Fill cells (grids (H, W): ranges first) without a return; return their number.

    Either most of their eight neighbours have a return, all at about one range: a beam there would have met the same
    surface. Or they lie between two lines of a pattern that leaves gaps: the next returns on opposite sides, a few
    cells away, agree in range. Larger gaps are holes: nothing returned from there.
    """
    filled = _fill_among_neighbours(grids)
    for _ in range(_FILL_PASSES):
        count = _fill_between_lines(grids)
        filled += count
        if not count:
            break
    return filled


def _fill_between_lines(grids: list[FloatArray]) -> int:
    """Fill empty cells between the next returns on opposite sides, if these agree in range; return their number.

    Of the row, the column and the diagonals, the one with the shortest gap counts.
    """
    width = grids[0].shape[1]
    padded = np.pad(grids[0], _GAP_CELLS, constant_values=np.nan)
    row, column = np.nonzero(np.isnan(grids[0]))
    shortest = np.full(len(row), float(_GAP_CELLS) + 1.5)  # in cells, with both ends
    first, second, share = (np.zeros(len(row), kind) for kind in (np.intp, np.intp, np.float32))
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before, after = (_cells_to_return(padded, row, column, (sign * i, sign * j)) for sign in (-1, 1))
        gap = (before + after) * np.hypot(i, j)
        better = np.flatnonzero((before > 0) & (after > 0) & (gap < shortest))
        ends = [
            (row[better] + sign * steps[better] * i) * width + column[better] + sign * steps[better] * j
            for sign, steps in ((-1, before), (1, after))
        ]
        near, far = (grids[0].reshape(-1)[end] for end in ends)
        alike = np.abs(near - far) <= range_tolerance(np.minimum(near, far))
        better = better[alike]
        first[better], second[better], shortest[better] = ends[0][alike], ends[1][alike], gap[better]
        share[better] = before[better] / (before + after)[better]
    found = np.flatnonzero(shortest <= _GAP_CELLS + 1)
    for grid in grids:
        flat = grid.reshape(-1)
        flat[row[found] * width + column[found]] = (1 - share[found]) * flat[first[found]] + share[found] * flat[
            second[found]
        ]
    return len(found)


def _cells_to_return(padded: FloatArray, row: IntArray, column: IntArray, direction: tuple[int, int]) -> IntArray:
    """Return the number of cells (N,) to the next return in a direction; 0: none within reach."""
    steps = np.zeros(len(row), np.intp)
    for n in range(_GAP_CELLS, 0, -1):
        there = np.isfinite(padded[row + _GAP_CELLS + n * direction[0], column + _GAP_CELLS + n * direction[1]])
        steps[there] = n
    return steps


def _fill_among_neighbours(grids: list[FloatArray]) -> int:
    ranges = grids[0]
    height, width = ranges.shape
    row, column = np.nonzero(np.isnan(ranges))
    inside = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    row, column = row[inside], column[inside]
    around = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    near = np.stack([ranges[row + i, column + j] for i, j in around])
    known = np.isfinite(near)
    lowest, highest = np.where(known, near, np.inf).min(axis=0), np.where(known, near, 0).max(axis=0)
    close = (known.sum(axis=0) >= _MIN_AROUND) & (highest - lowest <= range_tolerance(lowest))
    row, column, known = row[close], column[close], known[:, close]
    means = []
    for grid in grids:
        values = np.stack([grid[row + i, column + j] for i, j in around])
        means.append(np.where(known, values, 0).sum(axis=0) / known.sum(axis=0))
    for grid, mean in zip(grids, means, strict=True):
        grid[row, column] = mean
    return len(row)
