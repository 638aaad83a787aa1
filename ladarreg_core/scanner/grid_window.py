"""Part of a scanner's grid: a window of it, or every n-th of its rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scanner.grids import ScanGeometry, SeparableGrid, TabulatedGrid


@dataclass(frozen=True, eq=False)
class GridWindow:
    """The cells of a grid from `first` on, in steps."""

    grid: ScanGeometry
    """The whole grid."""
    first: tuple[int, int]
    """(row, column) of the first cell."""
    shape: tuple[int, int]
    """(H, W), cells of the part."""
    steps: tuple[int, int] = (1, 1)
    """Rows and columns of the grid from one cell of the part to the next."""

    @property
    def step_rad(self) -> tuple[float, float]:
        """The typical angle between neighbouring (rows, columns), rad."""
        whole = self.grid.step_rad
        return whole[0] * self.steps[0], whole[1] * self.steps[1]

    @cached_property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays, read-only."""
        rays = grid_rays(self.grid, *self._slices)
        rays.flags.writeable = False
        return rays

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3)."""
        return np.asarray((self.grid.cell_of(directions) - np.array(self.first)) / np.array(self.steps))

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        return self.grid.ray_at(np.asarray(cells, dtype=np.float64) * np.array(self.steps) + np.array(self.first))

    @property
    def _slices(self) -> tuple[slice, slice]:
        ends = (self.first[k] + (self.shape[k] - 1) * self.steps[k] + 1 for k in (0, 1))
        rows, columns = (slice(self.first[k], end, self.steps[k]) for k, end in enumerate(ends))
        return rows, columns


def grid_rays(grid: ScanGeometry, rows: slice, columns: slice) -> FloatArray:
    """Return the unit rays (h, w, 3) of some rows and columns; those of the rest are not computed."""
    if isinstance(grid, TabulatedGrid):
        return grid.table[rows, columns]
    kept = getattr(grid, "__dict__", {}).get("rays")  # of a whole grid that computed them once
    if kept is not None:
        return np.asarray(kept[rows, columns])
    places = [np.arange(n)[part] for n, part in zip(grid.shape, (rows, columns), strict=True)]
    while isinstance(grid, GridWindow):
        places = [first + step * place for first, step, place in zip(grid.first, grid.steps, places, strict=True)]
        grid = grid.grid
    if isinstance(grid, TabulatedGrid):
        return grid.table[np.ix_(*places)]
    if isinstance(grid, SeparableGrid):
        return grid.rays_of(*places)
    return grid.ray_at(np.stack(np.meshgrid(*places, indexing="ij"), axis=-1))
