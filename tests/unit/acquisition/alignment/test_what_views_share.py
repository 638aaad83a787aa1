"""What two views of one surface share: neither what stands before it, nor more than its panels and ledges let them."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.acquisition.alignment.adjustment import RangeView, adjust
from ladarreg_core.acquisition.alignment.intensity_links import BLUR_CELLS, links_of
from ladarreg_core.acquisition.alignment.intensity_view import IntensityView
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

GRID = AzimuthElevation(120, 160, np.radians(0.2), np.radians(0.2))
WALL_M, POST_M = 3.0, 1.0


def wall_behind_a_post(left_m: float) -> Scan:
    """Return a wall with dots 3 m ahead, and a bright post 1 m ahead, as seen from somewhat to the left."""
    rays = GRID.rays
    ahead = WALL_M / rays[..., 0]
    y, z = left_m + rays[..., 1] * ahead, rays[..., 2] * ahead
    light = 300.0 + 200.0 * (np.sin(40 * y) * np.sin(40 * z) > 0)
    near = POST_M / rays[..., 0]
    post = np.abs(left_m + rays[..., 1] * near - 0.05) < 0.02
    return Scan(GRID, np.where(post, near, ahead).astype(np.float32), np.where(post, 3000.0, light).astype(np.float32))


def nearest_to_the_post(apart_m: float) -> float:
    """Return how near to the post, in cells, the first of two scans so far apart is compared with the second."""
    scans = [wall_behind_a_post(0.0), wall_behind_a_post(apart_m)]
    levels = [[IntensityView.of(scan, 100.0, blur) for scan in scans] for blur in BLUR_CELLS[-1:]]
    poses = [Rigid.from_rotvec([0, 0, 0], [0.0, left, 0.0]) for left in (0.0, apart_m)]
    points = next(link for link in links_of(levels, poses) if link.first == 0).points
    post = np.flatnonzero((scans[0].ranges < 1.5).any(axis=0))
    column = np.asarray(GRID.cell_of(points))[:, 1]
    return float(np.abs(column[:, None] - post).min())


def test_beside_an_edge_scans_are_compared_only_if_nothing_moves_against_it() -> None:
    assert nearest_to_the_post(0.0002) < 8
    assert nearest_to_the_post(0.1) > 10


def corner(rng: np.random.Generator, panels_m: float, pose: Rigid) -> FloatArray:
    """Return points on three walls, on one of them each view on some of its panels, which stand out by millimetres."""
    points = []
    heights = np.random.default_rng(7).normal(scale=panels_m, size=(64, 64))
    for axis in range(3):
        along = rng.uniform(0.1, 2.9, (4000, 2))
        shown = np.random.default_rng(int(rng.integers(1 << 30))).random((64, 64)) < 0.6
        panel = (along / 0.15).astype(int)
        along, panel = along[shown[panel[:, 0], panel[:, 1]]], panel[shown[panel[:, 0], panel[:, 1]]]
        off = 3 + (axis == 2) * heights[panel[:, 0], panel[:, 1]] + rng.normal(scale=0.001, size=len(along))
        points.append(np.insert(along, axis, off, axis=1))
    return np.asarray(pose.inverse @ np.concatenate(points), np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("panels_m", [0.0, 0.003])
def test_a_wall_that_is_not_flat_is_believed_no_further_than_it_is(panels_m: float) -> None:
    square, count = 0.0, 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        views = [RangeView(corner(rng, panels_m, Rigid.identity()), Rigid.identity(), np.eye(6) * 1e10)]
        views.append(RangeView(corner(rng, panels_m, Rigid.identity()), Rigid.identity(), np.zeros((6, 6))))
        found = adjust(views)
        error = -np.concatenate([found.moved[1]])
        square += float(error @ np.linalg.solve(found.covariance[6:, 6:], error))
        count += 6
    assert 0.3 < np.sqrt(square / count) < 1.6
