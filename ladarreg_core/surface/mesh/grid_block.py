"""Blocks of a scan's grid, each meshed by itself: finer where one looks than a mesh of the whole scan may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh

FINEST_LEVEL = 8
_MIN_CELLS = 2
_SHARE_BEYOND = 64  # of the cells of a block: more than its step, so that it overlaps with the next one of any step


@dataclass(frozen=True, slots=True)
class GridBlock:
    """One of the 2^n x 2^n blocks that a grid is divided into."""

    level: int
    """n, 1 to `FINEST_LEVEL`."""
    row: int
    """Which block from the top, from 0."""
    column: int
    """Which block from the left, from 0."""

    def cells_of(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Return the rows and the columns of a grid (H, W) that it covers.

        Raises:
            OptionError: if the grid has no such block.
        """
        count = 2**self.level if 1 <= self.level <= FINEST_LEVEL else 0
        if not (0 <= self.row < count and 0 <= self.column < count) or min(shape) < _MIN_CELLS * count:
            raise OptionError(
                f"a grid of {shape[0]} x {shape[1]} cells has no block {self.row}, {self.column} of level {self.level}"
            )
        rows, columns = (
            slice(k * cells // count, (k + 1) * cells // count)
            for k, cells in zip((self.row, self.column), shape, strict=True)
        )
        return rows, columns


def block_mesh(scan: Scan, block: GridBlock, *, max_vertices: int) -> Mesh:
    """Return the surface of one block of a scan's grid, as `scan_mesh` returns that of all of it.

    It reaches somewhat beyond the block, so that no gap remains to the next one, whatever the steps of both.

    Returns:
        The mesh over the cells of the whole grid; without faces if the block has no surface.

    Raises:
        OptionError: if the grid has no such block, or `max_vertices` is below 4.
    """
    parts = block.cells_of(scan.shape)
    rows, columns = (
        slice(part.start, min(part.stop + (part.stop - part.start) // _SHARE_BEYOND + 1, cells))
        for part, cells in zip(parts, scan.shape, strict=True)
    )
    mesh = scan_mesh(scan.window(rows, columns), max_vertices=max_vertices)
    cells = mesh.cells + np.array([rows.start, columns.start], np.int32)
    return Mesh(mesh.vertices, mesh.faces, cells, scan.shape)
