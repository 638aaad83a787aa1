"""How much of a photograph each of several scans sees."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.overlap import seen_shares

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


def wall(depth_m: float, left: float = -1.0, right: float = 1.0, count: int = 6000) -> FloatArray:
    """Return points (N, 3) of a wall across the view, between shares -1 and 1 of its width."""
    rng = np.random.default_rng(int(10 * depth_m))
    x, y = rng.uniform(left, right, count) * 0.64 * depth_m, rng.uniform(-0.5, 0.5, count) * depth_m
    return np.stack([x, y, np.full(count, depth_m)], axis=-1)


def test_shares_are_of_what_is_in_front() -> None:
    half, whole, behind = wall(4.0, right=0.0), wall(4.05), wall(9.0)
    found = seen_shares(CAMERA, [half, whole, behind])
    assert found[0] == pytest.approx(0.5, abs=0.06)
    assert found[1] > 0.97
    assert found[2] == 0, "a wall in the next room"
    assert seen_shares(CAMERA, [behind]) == [pytest.approx(1.0, abs=0.03)]


def test_few_points_divide_the_photograph_coarsely() -> None:
    few = wall(4.0, count=60)
    assert seen_shares(CAMERA, [few])[0] > 0.9
    assert seen_shares(CAMERA, [np.zeros((0, 3)), few]) == [0, pytest.approx(1, abs=0.1)]


def test_what_is_not_in_view_is_not_seen() -> None:
    assert seen_shares(CAMERA, [-wall(4.0), wall(4.0) + np.array([40, 0, 0])]) == [0, 0]
    assert seen_shares(CAMERA, []) == []
