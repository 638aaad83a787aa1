"""Levels of a pair are computed once and equal those computed anew."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.scan_levels import ChannelSet, scan_levels
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=2)


@pytest.mark.parametrize("first", get_args(ChannelSet))
def test_shared_channels_equal_those_computed_anew(room: PaintedRoom, first: ChannelSet) -> None:
    direction = Rigid(look_along(room.scan.mean_direction), np.zeros(3))
    pair = PairLevels(room.scan, room.photo)
    known = pair.view(direction, first)
    assert known.channels
    assert known.fine_channels is not None
    for other in get_args(ChannelSet):
        shared = pair.view(direction, other)
        view = perspective_view(room.scan, pair.working, view_from_scanner=direction)
        anew = scan_levels(room.scan, view, channel_set=other)
        for mine, theirs in zip(shared.channels, anew.channels, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        np.testing.assert_array_equal(shared.fine_channels, anew.fine_channels)
        assert shared.gray_planes is known.gray_planes


def test_another_direction_is_another_view(room: PaintedRoom) -> None:
    pair = PairLevels(room.scan, room.photo)
    ahead = Rigid(look_along(room.scan.mean_direction), np.zeros(3))
    aside = Rigid(look_along(room.scan.mean_direction + np.array([0.0, 0.2, 0.0])), np.zeros(3))
    assert not np.array_equal(pair.view(ahead, "both").ranges, pair.view(aside, "both").ranges)
    assert pair.view(ahead, "both") is pair.view(Rigid(ahead.rotation.copy(), np.zeros(3)), "both")
    assert pair.photo is pair.photo


def test_a_large_scan_is_compared_in_the_window_of_the_view(room: PaintedRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    direction = Rigid(look_along(room.scan.mean_direction), np.zeros(3))
    whole = PairLevels(room.scan, room.photo).view(direction, "both")
    pair = PairLevels(room.scan, room.photo)
    pair.working = pair.working.scaled(0.5)
    small = perspective_view(room.scan, pair.working, view_from_scanner=direction)
    monkeypatch.setattr("ladarreg_core.matching.images.pair._LARGEST_WHOLE_SCAN", 1000)
    windowed = PairLevels(room.scan, room.photo).view(direction, "both")
    np.testing.assert_array_equal(np.isnan(windowed.ranges), np.isnan(whole.ranges))
    np.testing.assert_allclose(windowed.ranges, whole.ranges, atol=1e-4)
    for mine, theirs in zip(windowed.gray_planes, whole.gray_planes, strict=True):
        assert np.abs(mine - theirs).mean() < 0.05
    part = small.of_window(margin=4, most_cells=10**9)
    assert part.scan.ranges.size <= room.scan.ranges.size
    np.testing.assert_array_equal(part.inside, small.inside)
