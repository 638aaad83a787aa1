"""The inverse of a ray table: cells of directions inside, around and far from it."""

from __future__ import annotations

import numpy as np

from ladarreg_core.scanner.ray_table import RayTableInverse


def sector(rows: int, columns: int, step_rad: float) -> np.ndarray:
    """Return the rays (rows, columns, 3) of a narrow scan whose rows lie unevenly."""
    elevation = np.linspace(0, 1, rows)[:, None] ** 1.3 * rows * step_rad - 0.3
    azimuth = np.arange(columns) * step_rad
    level = np.cos(elevation)
    rays = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.broadcast_to(np.sin(elevation), (rows, columns))]
    )
    return np.moveaxis(rays, 0, -1)


def test_directions_far_from_a_narrow_table_have_no_cell_and_those_beside_it_do() -> None:
    rays = sector(60, 90, 0.01)
    inverse = RayTableInverse(rays)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    cells = inverse.cell_of(directions)
    away = np.degrees(
        np.arccos(np.clip((directions / np.linalg.norm(directions, axis=1)[:, None]) @ rays[30, 45], -1, 1))
    )
    assert np.isnan(cells[away > 70]).all()
    assert np.count_nonzero(np.isfinite(cells[:, 0])) > 300
    beside = 2 * rays[:, 0] - rays[:, 12]  # twelve columns before the first one, nearly
    found = inverse.cell_of(beside)
    assert np.isfinite(found).all()
    assert np.abs(found[:, 1] + 12).max() < 1
