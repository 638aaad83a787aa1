"""Blocks of a grid: together the surface of the scan, each of bounded size, and overlapping."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.mesh.grid_block import GridBlock, block_mesh
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh
from testing.scenes.box_room import distances, off_surface

SHAPE = (93, 170)


def room_scan(shape: tuple[int, int] = SHAPE) -> Scan:
    step = 2 * np.pi / shape[1]
    grid = SphericalGrid(*shape, step, step, 0.0, 0.0)
    ranges = distances(np.zeros(3), np.asarray(grid.rays, np.float64)).astype(np.float32)
    return Scan(grid, ranges, np.ones(shape, np.float32))


def triangles(mesh: Mesh, scan: Scan) -> set[tuple[int, ...]]:
    """Return the triangles of a mesh by their cells."""
    cells = np.ravel_multi_index(mesh.cells.T, scan.shape)
    return {tuple(row) for row in np.sort(cells[mesh.faces], axis=1).tolist()}


def blocks_of(level: int) -> list[GridBlock]:
    return [GridBlock(level, row, column) for row in range(2**level) for column in range(2**level)]


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 3])
def test_at_full_resolution_the_blocks_are_the_surface_of_the_scan(level: int) -> None:
    scan = room_scan()
    of_blocks = set().union(*(triangles(block_mesh(scan, each, max_vertices=10**6), scan) for each in blocks_of(level)))
    whole = triangles(scan_mesh(scan), scan)
    # An edge of depth is judged by the cells beside it, which a block lacks at its border.
    assert len(whole - of_blocks) < 0.01 * len(whole)
    assert len(of_blocks - whole) < 0.01 * len(whole)


def test_a_block_is_bounded_true_and_leaves_no_gap_to_the_next_one() -> None:
    scan = room_scan((400, 800))
    for block in blocks_of(2):
        mesh = block_mesh(scan, block, max_vertices=900)
        assert 300 < len(mesh.vertices) <= 900
        rows, columns = block.cells_of(scan.shape)
        at = mesh.cells
        assert (at.min(axis=0) == [rows.start, columns.start]).all()
        assert (at.max(axis=0) >= np.minimum([rows.stop, columns.stop], np.array(scan.shape) - 8) - 1).all()
        np.testing.assert_allclose(mesh.vertices, scan.points[at[:, 0], at[:, 1]], atol=1e-6)
        assert np.abs(off_surface(mesh.vertices)).max() < 1e-4


@pytest.mark.parametrize("numbers", [(0, 0, 0), (9, 0, 0), (2, 4, 0), (2, 0, -1), (7, 0, 0)])
def test_blocks_that_a_grid_does_not_have_are_refused(numbers: tuple[int, int, int]) -> None:
    with pytest.raises(OptionError, match="93 x 170 cells has no block"):
        block_mesh(room_scan(), GridBlock(*numbers), max_vertices=100)
