"""Rays of parts of grids, and of parts of parts, are those of their cells."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grid_window import GridWindow, grid_rays
from ladarreg_core.scanner.grids import (
    AzimuthElevation,
    PinholeGrid,
    RingGrid,
    RotatedGrid,
    ScanGeometry,
    SphericalGrid,
    TabulatedGrid,
)

SPHERICAL = SphericalGrid(60, 140, 0.04, 0.03, 0.3, 0.9)
LEANING = RotatedGrid(SPHERICAL, Rigid.from_rotvec([0.3, -0.5, 0.2]).rotation)
GRIDS: tuple[ScanGeometry, ...] = (
    SPHERICAL,
    AzimuthElevation(60, 140, 0.008, 0.01, 0.1, 0.2),
    LEANING,
    RingGrid(np.linspace(0.5, -0.5, 60), np.linspace(0, 0.4, 60), 140, 0.04, 0.1),
    PinholeGrid(Camera.from_focal(140, 60, 90.0)),
    TabulatedGrid(np.array(SPHERICAL.rays)),
)


@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: type(grid).__name__)
def test_rays_of_parts_are_those_of_their_cells(grid: ScanGeometry) -> None:
    rows, columns = slice(7, 51, 3), slice(5, 130, 2)
    cells = np.stack(np.mgrid[rows, columns], axis=-1)
    part = grid_rays(grid, rows, columns)
    np.testing.assert_allclose(part, grid.ray_at(cells), atol=1e-12)
    window = GridWindow(grid, (7, 5), part.shape[:2], (3, 2))
    np.testing.assert_array_equal(window.rays, part)
    inner = grid_rays(window, slice(1, 12, 2), slice(4, None, 5))
    np.testing.assert_array_equal(inner, part[1:12:2, 4::5])
    fresh = GridWindow(GridWindow(grid, (7, 5), part.shape[:2], (3, 2)), (1, 4), inner.shape[:2], (2, 5))
    np.testing.assert_allclose(fresh.rays, inner, atol=1e-12)
    np.testing.assert_allclose(grid.rays[rows, columns], part, atol=1e-12)


def test_some_rays_of_a_large_grid_do_not_take_all() -> None:
    grid = SphericalGrid(300, 700, 0.008, 0.006, 0.3, 1.2)
    grid_rays(grid, slice(10, 20), slice(None))
    assert "rays" not in grid.__dict__, "it would keep 24 bytes a cell"
