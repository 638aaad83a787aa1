"""Gridding of clouds: points are kept, rings stay rings, nothing is mirrored."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import ShapeError
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.gridding import grid_points
from ladarreg_core.scanner.grids import RingGrid, RotatedGrid, SphericalGrid
from testing.scenes.simulated_clouds import brightness, in_room, rosette

# The elevations of a real 64-beam scanner: .17 deg in the middle, 5 deg at the ends.
UNEVEN = np.concatenate([[-25, -19, -14, -13, -12, -11, -10, -9, -8, -7], np.arange(-6, 2.1, 0.17), [3, 5, 8, 11, 15]])


def cells_of_points(cloud: Any, points: np.ndarray) -> np.ndarray:
    """Cells (K, 2) with a return, after checking that their points are input points, unmoved."""
    valid = np.isfinite(cloud.ranges)
    found = cloud.geometry.rays[valid] * cloud.ranges[valid][:, None].astype(np.float64)
    known = {tuple(p) for p in np.round(points, 3).tolist()}
    near = sum(tuple(p) in known for p in np.round(found, 3).tolist())
    assert near > 0.97 * len(found), "points moved"  # rounding of the last digit separates a few
    return np.argwhere(valid)


@pytest.mark.slow
@settings(max_examples=25)
@given(
    seed=st.integers(0, 100),
    columns=st.integers(90, 400),
    jitter=st.sampled_from([0.0, 0.004]),
    uneven=st.booleans(),
    tell_ring=st.booleans(),
)
def test_rings_become_rows_and_keep_their_points(
    make: Any, seed: int, columns: int, jitter: float, uneven: bool, tell_ring: bool
) -> None:
    latitudes = UNEVEN if uneven else np.linspace(-15, 15, 16)
    stagger = np.random.default_rng(seed).uniform(-2, 2, len(latitudes))
    points, intensity, ring = make.spinning(latitudes, columns, seed=seed, stagger=stagger, jitter_deg=jitter)
    cloud = grid_points(points, intensity, ring=ring if tell_ring else None)
    assert cloud.rings == len(latitudes)
    assert cloud.geometry.shape == (len(latitudes), columns)
    assert cloud.points_kept == len(points)
    cells = cells_of_points(cloud, points)
    law = cloud.geometry.cell_of(cloud.geometry.rays[cells[:, 0], cells[:, 1]])
    off = np.abs(law - cells)
    off[:, 1] = np.minimum(off[:, 1], columns - off[:, 1])  # the seam
    assert np.quantile(off, 0.99) < 0.2


def test_wrong_ring_numbers_are_ignored(make: Any) -> None:
    points, intensity, ring = make.spinning(np.linspace(-15, 15, 16), 200)
    lies = np.random.default_rng(0).permutation(ring)
    assert grid_points(points, intensity, ring=lies).points_kept == len(points)


@settings(max_examples=20)
@given(seed=st.integers(0, 50), aspect=st.floats(0.3, 3), jitter=st.floats(0, 0.1))
def test_a_slanted_lattice_is_gridded_by_its_own_steps(seed: int, aspect: float, jitter: float) -> None:
    generator = np.random.default_rng(seed)
    row, column = np.mgrid[:60, :80]
    step = np.radians(0.3)
    latitude = (30 - row) * step + generator.normal(0, jitter * step, row.shape)
    longitude = (40 - column) * step * aspect + 0.006 * latitude + generator.normal(0, jitter * step, row.shape)
    points = 4 * np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    cloud = grid_points(points.reshape(-1, 3), np.ones(row.size))
    assert cloud.points_kept > 0.75 * row.size
    assert np.isfinite(cloud.ranges).mean() > 0.7


@pytest.mark.slow
@settings(max_examples=15)
@given(seed=st.integers(0, 50), count=st.integers(400, 5000))
def test_scattered_points_fill_isotropic_cells(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    longitude, latitude = generator.uniform(-0.5, 0.5, count), generator.uniform(-0.3, 0.3, count)
    rays = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    cloud = grid_points(rays * generator.uniform(1, 9, (count, 1)), np.ones(count))
    assert cloud.rings == 0
    assert isinstance(cloud.geometry.law, SphericalGrid)
    lat_step, lon_step = cloud.geometry.step_rad
    assert 0.5 < lat_step / lon_step < 2
    assert cloud.points_kept > 0.5 * count
    cells = np.argwhere(np.isfinite(cloud.ranges))
    law = cloud.geometry.cell_of(cloud.geometry.rays[cells[:, 0], cells[:, 1]])
    assert np.abs(law - cells).max() < 0.501


def test_left_is_left_and_up_is_up() -> None:
    generator = np.random.default_rng(0)
    angles = generator.uniform(-0.4, 0.4, (3000, 2))
    rays = np.stack(
        [np.cos(angles[:, 1]) * np.cos(angles[:, 0]), np.cos(angles[:, 1]) * np.sin(angles[:, 0]),
         np.sin(angles[:, 1])], axis=-1,
    )  # fmt: skip
    cloud = grid_points(rays * 5, angles[:, 0] * 100)
    valid = np.isfinite(cloud.ranges)
    row, column = np.nonzero(valid)
    y, z = cloud.geometry.rays[valid][:, 1], cloud.geometry.rays[valid][:, 2]
    assert np.corrcoef(column, y)[0, 1] < -0.98
    assert np.corrcoef(row, z)[0, 1] < -0.98
    assert np.corrcoef(column, cloud.intensity[valid])[0, 1] < -0.98


@pytest.mark.parametrize("away", [np.pi, 3.0, -2.0, 0.4])
def test_a_narrow_cloud_behind_the_scanner_is_not_cut_by_the_seam(away: float) -> None:
    generator = np.random.default_rng(1)
    longitude, latitude = generator.uniform(-0.5, 0.5, 2000) + away, generator.uniform(-0.3, 0.3, 2000)
    rays = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    cloud = grid_points(rays, np.ones(2000))
    assert np.isfinite(cloud.ranges).mean() > 0.4
    assert cloud.geometry.shape[1] < 100


def test_the_nearest_of_several_points_stays_with_its_own_values() -> None:
    generator = np.random.default_rng(2)
    latitude, longitude = (a.ravel() for a in np.meshgrid(np.linspace(-0.2, 0.2, 20), np.linspace(-0.3, 0.3, 30)))
    rays = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    near, far = generator.uniform(1, 2, len(rays)), generator.uniform(3, 4, len(rays))
    points = np.concatenate([rays * far[:, None], rays * near[:, None]])
    color = np.repeat([[9, 9, 9], [200, 100, 50]], len(rays), axis=0)
    cloud = grid_points(points, np.concatenate([far, near]), color)
    valid = np.isfinite(cloud.ranges)
    assert valid.sum() == len(rays)
    np.testing.assert_allclose(np.sort(cloud.ranges[valid]), np.sort(near), rtol=1e-6)
    np.testing.assert_array_equal(cloud.intensity[valid], cloud.ranges[valid])
    assert cloud.color is not None
    assert (cloud.color[valid] == [200, 100, 50]).all()


def test_a_cloud_in_an_optical_frame_is_not_gridded_around_the_pole(wall: Scan) -> None:
    points = wall.points[wall.valid]
    forward = grid_points(points, np.ones(len(points)))
    for turn in (np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])):
        cloud = grid_points(points @ turn.T, np.ones(len(points)))
        assert isinstance(cloud.geometry.law, RotatedGrid)
        assert abs(cloud.points_kept - forward.points_kept) < 0.05 * len(points)
        cells = np.argwhere(np.isfinite(cloud.ranges))
        law = cloud.geometry.cell_of(cloud.geometry.rays[cells[:, 0], cells[:, 1]])
        assert np.abs(law - cells).max() < 0.501


def test_outliers_do_not_stretch_the_grid_beyond_bounds() -> None:
    generator = np.random.default_rng(3)
    cluster = np.array([1.0, 0, 0]) + generator.normal(0, 1e-4, (5000, 3))
    cloud = grid_points(np.concatenate([cluster, [[0, 1, 0.5], [0, -1, -0.9]]]), np.ones(5002))
    rows, columns = cloud.geometry.shape
    assert rows * columns <= 40 * 5002 * 1.1


def test_too_little_is_refused() -> None:
    for points, word in (
        (np.zeros((0, 3)), "0 returns"),
        (np.ones((5, 3)), "5 returns"),
        (np.full((50, 3), np.nan), "0 returns"),
        (np.ones((50, 3)) * np.arange(1, 51)[:, None], "1 x 1"),
    ):
        with pytest.raises(ShapeError, match=word):
            grid_points(points, np.ones(len(points)))
    with pytest.raises(ShapeError, match="intensity"):
        grid_points(np.ones((50, 3)), np.ones(49))


@given(
    gaps=st.lists(st.floats(0.002, 0.1), min_size=1, max_size=30),
    phase=st.floats(-0.5, 0.5),
    centre=st.floats(-3, 3),
    at=st.tuples(st.floats(0, 1), st.floats(0.02, 0.98)),
)
def test_ring_grids_invert_themselves(gaps: list[float], phase: float, centre: float, at: tuple[float, float]) -> None:
    latitudes = 0.6 - np.append(0, np.cumsum(gaps)) * 0.5
    grid = RingGrid(latitudes, np.linspace(0, phase, len(latitudes)), 300, 0.01, centre)
    cell = np.array([at[0] * (len(latitudes) - 1), at[1] * 299])
    np.testing.assert_allclose(grid.cell_of(grid.ray_at(cell)), cell, atol=1e-6)
    assert grid.rays.shape == (*grid.shape, 3)


@pytest.mark.slow
def test_accumulated_sweeps_fill_their_cells_and_keep_their_holes() -> None:
    scanner = np.array([0.4, -0.6, 1.5])
    rays = rosette(150_000)
    longitude, latitude = np.arctan2(rays[:, 1], rays[:, 0]), np.arcsin(rays[:, 2])
    window = (np.abs(longitude - 0.2) < 0.06) & (np.abs(latitude - 0.1) < 0.06)  # an open window: nothing returns
    points = in_room(rays[~window], noise_m=0.01)
    cloud = grid_points(points - scanner, brightness(points))
    assert cloud.accumulated
    assert "unordered" in cloud.describe()
    assert cloud.lost_share < 0.02
    found = cloud.geometry.rays
    towards_window = (np.abs(np.arctan2(found[..., 1], found[..., 0]) - 0.2) < 0.04) & (
        np.abs(np.arcsin(found[..., 2]) - 0.1) < 0.04
    )
    seen = np.arccos(found[..., 0].clip(-1, 1)) < np.radians(34)
    valid = np.isfinite(cloud.ranges)
    assert not valid[towards_window].any(), "a hole is not filled"
    around = seen & ~((np.abs(np.arctan2(found[..., 1], found[..., 0]) - 0.2) < 0.08) & (
        np.abs(np.arcsin(found[..., 2]) - 0.1) < 0.08))  # fmt: skip
    assert valid[around].mean() > 0.94
    # The control: cells of the mean spacing, as of a raster of as many points, are riddled with gaps.
    outer = ~window & (np.arccos(rays[:, 0]) > np.radians(20)) & (np.arccos(rays[:, 0]) < np.radians(30))
    side = np.sqrt(np.pi / 4 * np.radians(70) ** 2 / len(rays))
    cells = len(np.unique(np.floor(np.stack([longitude, latitude], -1)[outer] / side), axis=0))
    ring_area = 2 * np.pi * (np.cos(np.radians(20)) - np.cos(np.radians(30)))
    assert cells * side**2 / ring_area < 0.8
    # The mean of several points has less noise than the nearest of them.
    truth = in_room(found[around & valid], noise_m=0.0) - scanner
    error = cloud.ranges[around & valid] - np.linalg.norm(truth, axis=1)
    assert np.abs(np.median(error)) < 0.002
    assert 1.4826 * np.median(np.abs(error)) < 0.008


def test_a_pattern_that_nearly_repeats_is_filled_between_its_lines_and_not_across_edges() -> None:
    """Its points crowd on few lines: the steps follow the lines' distance, and the cells between them are filled."""
    rng = np.random.default_rng(5)
    turn = rng.uniform(0, 2 * np.pi, 60_000)
    ring = np.radians(1.0 + 0.4 * rng.integers(0, 70, len(turn)))
    polar = ring + np.radians(0.01) * rng.standard_normal(len(turn))
    rays = np.stack([np.cos(polar), np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn)], axis=-1)
    depth = np.where(rays[:, 1] > 0.1 * rays[:, 0], 8.0, 12.0)  # two walls, one in front of the other
    noise = 0.01 * rng.standard_normal(len(rays))
    cloud = grid_points(rays * (depth / rays[:, 0] + noise)[:, None], np.ones(len(rays)))
    assert cloud.accumulated
    found = cloud.geometry.rays
    inside = np.arccos(found[..., 0].clip(-1, 1)) < np.radians(26)
    valid = np.isfinite(cloud.ranges)
    beside_edge = np.abs(found[..., 1] / found[..., 0] - 0.1) < 0.02
    assert valid[inside & ~beside_edge].mean() > 0.97
    at = cloud.ranges[inside & valid] * found[inside & valid][:, 0]
    assert (np.minimum(np.abs(at - 8), np.abs(at - 12)) < 0.15).mean() > 0.999, "no cell lies between the walls"
