"""Sampling of a level: the strongest pixels of every stratum, reproducible by seed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.matching.images.photo_levels import working_camera
from ladarreg_core.matching.images.sampling import _strongest_in_strata, draw_points, edge_strength
from ladarreg_core.matching.images.scan_levels import ScanLevels, scan_levels
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import painted_room


@given(
    seed=st.integers(0, 2**31),
    height=st.integers(5, 70),
    width=st.integers(5, 70),
    side=st.sampled_from([8, 16, 32]),
    count=st.integers(1, 6000),
    levels=st.sampled_from([2, 5, 1000]),
)
def test_the_strongest_pixels_of_each_stratum_are_kept(
    seed: int, height: int, width: int, side: int, count: int, levels: int
) -> None:
    strength = (np.random.default_rng(seed).integers(0, levels, (height, width)) / levels).astype(np.float32)
    strength[::2, 1::2] = strength[1::2, ::2] = 0
    kept = _strongest_in_strata(strength, side, count)
    assert len(np.unique(kept)) == len(kept)
    chosen = np.zeros(strength.size, bool)
    chosen[kept] = True
    chosen = chosen.reshape(strength.shape)
    assert not chosen[strength == 0].any()
    blocks = [(i, j) for i in range(0, height, side) for j in range(0, width, side)]
    filled = sum(strength[i : i + side, j : j + side].any() for i, j in blocks)
    for i, j in blocks:
        here, taken = strength[i : i + side, j : j + side], chosen[i : i + side, j : j + side]
        asked = min(-(-count // max(filled, 1)), np.count_nonzero(here))
        assert taken.sum() >= asked
        if taken.any():  # of equally strong pixels all are taken
            least = here[taken].min()
            assert np.count_nonzero(here > least) < asked
            assert taken[here >= least].all()


@pytest.fixture(scope="module")
def levels() -> ScanLevels:
    room = painted_room(seed=2)
    return scan_levels(room.scan, perspective_view(room.scan, working_camera(room.scan, room.photo.camera)))


def test_points_are_drawn_by_seed_and_sorted_by_block(levels: ScanLevels) -> None:
    channels = levels.channels[1]
    strength = edge_strength(levels, channels, level=1)
    assert strength is not None
    some, again, others = (draw_points(levels, channels, strength, level=1, seed=s, count=900) for s in (4, 4, 5))
    np.testing.assert_array_equal(some.points, again.points)
    assert not np.array_equal(some.points, others.points)
    assert len(some) == 900
    assert (np.diff(some.blocks.of_point) >= 0).all()
    np.testing.assert_array_equal(some.blocks.of_point[some.blocks.starts], np.arange(len(some.blocks)))
    np.testing.assert_array_equal(some.uv[some.blocks.starts] // 24, some.blocks.grid[:, ::-1])
    u, v = some.uv.T.astype(int)
    np.testing.assert_array_equal(some.channels, channels[v, u])


def test_a_view_without_edges_gives_none(levels: ScanLevels) -> None:
    assert edge_strength(levels, np.zeros_like(levels.channels[0]), level=0) is None
