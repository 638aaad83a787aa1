"""Ranges between the lines of coarse scans: exact on planes, never across a depth edge, never in a hole."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.matches import Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.ranges import measured_ranges, range_quality

STEP = np.radians((0.4, 0.2))
HEIGHT_M, WALL_M, POST_M = 1.8, 20.0, 8.0


def scan_of(ranges: NDArray[np.float64]) -> Scan:
    rows, columns = ranges.shape
    # looks a little downwards, as a lidar on a vehicle does
    grid = SphericalGrid(rows, columns, STEP[1], STEP[0], 0.0, float(np.radians(2.0)))
    return Scan(geometry=grid, ranges=ranges, intensity=np.ones_like(ranges))


def ground_and_wall(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ranges of a ground, a wall behind it, and nothing else."""
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, -HEIGHT_M / rays[..., 2], np.inf)
        wall = np.where(rays[..., 0] > 0, WALL_M / rays[..., 0], np.inf)
    return np.asarray(np.minimum(ground, wall))


@pytest.fixture(scope="module")
def rays() -> NDArray[np.float64]:
    empty = scan_of(np.full((40, 120), 5.0))
    return np.asarray(empty.rays, np.float64)


def between(scan: Scan, low: tuple[float, float], high: tuple[float, float], count: int = 500) -> NDArray[np.float64]:
    cells = np.random.default_rng(0).uniform(low, high, (count, 2))
    return np.asarray(scan.geometry.ray_at(cells))


def test_the_ground_between_lines_is_exact(rays: NDArray[np.float64]) -> None:
    scan = scan_of(ground_and_wall(rays))
    asked = between(scan, (20, 10), (38, 110))
    found = measured_ranges(scan, asked)
    steep = np.isfinite(found.sigma)
    assert steep.mean() > 0.4  # neighbouring lines are more than 4 % apart
    np.testing.assert_allclose(found.ranges, ground_and_wall(asked), rtol=2e-3)


def test_nothing_is_found_across_a_depth_edge(rays: NDArray[np.float64]) -> None:
    ranges = ground_and_wall(rays)
    ranges[4:30, 60:] = POST_M
    scan = scan_of(ranges)
    found = measured_ranges(scan, between(scan, (6, 59.05), (20, 59.95)))
    assert np.isnan(found.ranges).all()
    assert found.edge.all()
    np.testing.assert_allclose(found.outline, POST_M, rtol=1e-6)


def test_cells_that_an_accumulated_cloud_left_empty_are_filled(rays: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(1)
    ranges = ground_and_wall(rays)
    noisy = ranges + rng.normal(0, 0.02, ranges.shape)
    scan = scan_of(np.where(rng.random(ranges.shape) < 0.35, np.nan, noisy))
    asked = between(scan, (12, 10), (36, 110))
    found = measured_ranges(scan, asked)
    known = np.isfinite(found.ranges)
    assert known.mean() > 0.85
    error, sigma = found.ranges[known] - ground_and_wall(asked)[known], found.sigma[known]
    filled = np.isfinite(sigma)
    assert 0.015 < np.median(sigma[filled]) < 0.04  # of a single return, of which there are some
    assert (np.abs(error[filled]) < 3 * np.maximum(sigma[filled], 0.02)).mean() > 0.97
    assert (range_quality(scan, asked, found) <= 4).all()


def test_a_hole_in_a_dense_scan_stays_one(rays: NDArray[np.float64]) -> None:
    ranges = np.full(rays.shape[:2], 6.0)
    ranges[20:23, 60:63] = np.nan
    scan = scan_of(ranges)
    found = measured_ranges(scan, between(scan, (20.1, 60.1), (21.9, 61.9)))
    assert np.isnan(found.ranges).all()


def test_points_on_outlines_of_a_coarse_scan_are_kept_with_little_weight(rays: NDArray[np.float64]) -> None:
    ranges = ground_and_wall(rays)
    ranges[4:30, 60:] = POST_M
    scan = scan_of(ranges)
    ray = np.asarray(scan.geometry.ray_at(np.array([[12.3, 59.6], [12.3, 80.2]])))
    picks = [Pick(str(k), "point", ray[k : k + 1], np.array([[100.0 + k, 80.0]])) for k in range(2)]
    kept, notes = matches_from_picks(scan, picks, camera=Camera.from_focal(640, 480, 600.0))
    assert notes == ()
    np.testing.assert_allclose(kept.ranges, POST_M, rtol=1e-3)
    assert kept.range_weights[0] < 0.05 * kept.range_weights[1]
    # A photograph that is as coarse shows its corners inside the surfaces, too: an outline may belong to either.
    lost, notes = matches_from_picks(scan, picks, camera=Camera.from_focal(200, 150, 150.0))
    assert lost.pick_ids == ("1",)
    assert "at a depth edge" in notes[0]
